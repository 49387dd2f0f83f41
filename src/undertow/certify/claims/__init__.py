"""A certificate: what is claimed of what, how it is read, written and verified; the gate."""
