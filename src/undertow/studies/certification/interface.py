"""Certify and verify in Python: a surface to a certificate, a certificate to what still holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from undertow.base import Progress, checked, no_progress, positive, require, versions
from undertow.law import ReachingLaw, Surface, usual_reaching
from undertow.models import Mechanism, StateLike
from undertow.plants import Bench
from undertow.proofs import Certificate, read_certificate
from undertow.proofs.claims.verify import Checked
from undertow.proofs.claims.verify import verify as decide
from undertow.studies.certification.bench import certify_bench
from undertow.studies.certification.decide import LOOP_SECONDS, certify_surface


@checked
def certify(
    mechanism: Mechanism,
    surface: Surface,
    x0: StateLike | None = None,
    *,
    reaching: ReachingLaw | None = None,
    seconds: float = 60.0,
    loop: bool = False,
    loop_seconds: float = LOOP_SECONDS,
    hold: int = 0,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    bench: Bench | None = None,
    progress: Progress | None = None,
    **state: float,
) -> Certificate:
    """Prove what can be proved of a surface: stability, terminal set, domain, disturbances, region.

    Parameters
    ----------
    mechanism
        Belief and plant.
    surface, reaching
        The law; where ``reaching`` is left out, :func:`undertow.law.usual_reaching` on the surface.
    x0
        A state, (2n,), or its non-zero entries by name (``phi=0.7``): its positions, with both
        signs, span the region in which the law must exist, and say which way the region of
        attraction should reach.  With neither, the mechanism's usual ``start``, if it has one.
    seconds
        Effort for the region on the surface, s; 0 leaves it out.
    loop
        Also prove how much of x0 the full closed loop may start at: along a line where x0 has one
        state that is not 0, else in a box, all of them at once with both signs.
    loop_seconds
        Process time of the search for that, s; the proof takes about as much again.
    hold
        For that proof: the input is held for so many steps of 1 ms (0: at every instant).
    uncertain
        Plant parameters that lie in [low, high] instead of being the law's own: for that proof,
        with an input that is held, and for a second region on the surface.
    bench
        Certify the loop that a run closes on this bench, whose mechanism it must be: ``loop`` and
        ``hold`` are left out then, for its period says them, and the usual ``reaching`` law is that
        of a run. Law and exported C are tried on random rigs besides: remarks of the subject, which
        no file keeps.
    progress
        Called with (what, part done).

    Returns
    -------
    Certificate
        ``print`` shows its claims; ``.save("certificate.json")`` writes the file that
        :func:`verify` reads.

    Raises
    ------
    ModelError
        For a mechanism that is not smooth.
    InvalidInputError
        For a setting of a proof that is not asked for.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> certificate = certify(rig, ut.first_surface(rig), seconds=0)
    >>> certificate.subjects[0].claims[0].kind
    'stability'
    """
    positive("time of the search, s", seconds, zero=True)
    positive("time of the loop's search, s", loop_seconds)
    if bench is not None:
        same, given = bench.mechanism.fingerprint == mechanism.fingerprint, bench.mechanism.name
        require(same, "mechanism of the bench", f"another '{given}'", "the one that is certified")
        require(not (loop or hold), "loop and hold, with a bench", (loop, hold), "left out")
    else:
        given, own = "without loop=True", "left out: it is for the closed loop's proof"
        require(loop or not hold, "hold", f"{hold}, {given}", own)
        untold = loop or loop_seconds == LOOP_SECONDS
        require(untold, "loop_seconds", f"{loop_seconds:g}, {given}", own)
        bears = "a region to prove it for, seconds above 0, or loop=True"
        require(loop or seconds or not uncertain, "uncertain", uncertain, bears)
        held = "a held input, such as hold=1"
        require(hold or not (loop and uncertain), "uncertain, with loop=True", uncertain, held)
    known = x0 is not None or state or mechanism.start
    start = mechanism.initial_state(x0, state) if known else np.zeros(2 * mechanism.n)
    progress = progress or no_progress
    if bench is not None:
        certified = certify_bench(
            bench, surface, start, reaching_law=reaching, seconds=seconds,
            loop_seconds=loop_seconds, uncertain=uncertain, progress=progress,
        )  # fmt: skip
    else:
        certified = certify_surface(
            mechanism, surface, start,
            reaching_law=usual_reaching(mechanism, surface) if reaching is None else reaching,
            seconds=seconds, loop=loop, loop_seconds=loop_seconds, hold=hold, uncertain=uncertain,
            progress=progress,
        )  # fmt: skip
    return Certificate.of(mechanism, [certified.subject], versions())


@dataclass(frozen=True)
class Verification:
    """The claims of a certificate, each decided again; true if all of them hold.

    ``name``: the mechanism's. ``checked``: in the order of the file.
    """

    name: str
    checked: tuple[Checked, ...]

    def __bool__(self) -> bool:
        """Whether every claim was proved again."""
        return all(item.verdict for item in self.checked)

    def __iter__(self) -> Iterator[Checked]:
        """Iterate over the claims."""
        return iter(self.checked)

    def __repr__(self) -> str:
        """Show how many claims hold."""
        held = sum(bool(item.verdict) for item in self.checked)
        return f"Verification({self.name}, {held} of {len(self.checked)} claims proved again)"

    def __str__(self) -> str:
        """Return a line for each claim, as it was decided now."""
        lines = (f"  {item.verdict.kind}: {item.verdict.claim}" for item in self.checked)
        return "\n".join([f"{self.name}:", *lines])


@checked
def verify(
    certificate: Certificate | str | Path, mechanism: Mechanism, *, progress: Progress | None = None
) -> Verification:
    """Decide every claim of a certificate again, for a mechanism with its own parameters.

    Nothing of the file is believed but the numbers that it brings to try.

    Parameters
    ----------
    certificate
        The file, or what :func:`certify` returned.
    mechanism
        Which it must be about: the same equations, parameters and input limits.
    progress
        Called with (claim, part done).

    Raises
    ------
    ArtefactError, CertificateError
        When the file cannot be read, is damaged, or is about another mechanism.
    """
    given = (
        certificate if isinstance(certificate, Certificate) else read_certificate(Path(certificate))
    )
    found = decide(given, mechanism, own_parameters=True, progress=progress)
    return Verification(given.name, found)
