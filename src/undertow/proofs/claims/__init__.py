"""A file for each kind of claim; the certificate that states claims, and its verification.

Begin at :mod:`.claim`. :mod:`.document` writes and reads the file, :mod:`.verify` decides it again.
"""
