"""A file for each kind of claim; the certificate that states claims, and its verification."""
