"""Searches for what is then proved: nothing here is trusted, and nothing that decides uses it."""
