"""Claims about a surface: stability, singularity, reaching, ellipsoids."""
