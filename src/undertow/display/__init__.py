"""What people see: formulas, sketches, plots and films."""
