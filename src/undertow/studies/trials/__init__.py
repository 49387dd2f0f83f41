"""Trials: controllers on realistic rigs, many seeds, in tables and figures."""
