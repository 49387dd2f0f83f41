"""Arithmetic with rounding that encloses: intervals, exact models, branch and bound."""
