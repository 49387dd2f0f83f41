"""Claims about regions of attraction."""
