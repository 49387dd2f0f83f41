"""Searches for what is then proved: nothing here is trusted, and no proof imports it."""
