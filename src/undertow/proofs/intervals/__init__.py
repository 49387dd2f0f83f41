"""Arithmetic with rounding that encloses: intervals, Taylor models, branch and bound."""
