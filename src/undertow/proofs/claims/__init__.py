"""A file for each kind of claim; the certificate that states claims, and its verification.

Begin at :mod:`.claim`. :mod:`.document` writes what the kernel decides, :mod:`.verify` reads a
file again; ``CLAIMS`` there lists the kinds that can be read.
"""
