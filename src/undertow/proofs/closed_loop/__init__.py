"""Claims about the closed loop: tubes of motions, and the set in which they end."""
