"""A file for each kind of claim; the certificate that states claims, and its verification.

Begin at :mod:`.claim`. :mod:`.document` writes and reads the file, :mod:`.verify` decides it again.
"""

from undertow.proofs.claims import (  # noqa: F401 - each has the words of its kind
    closed_loop,
    nonsingular,
    reaching,
    region,
    stability,
    terminal_ellipsoid,
)
