"""What the C and Python share: names and words in ASCII, status bits, answers to a plan."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from enum import IntEnum, IntFlag
from importlib import resources
from string import Template

import sympy as sp

from undertow.models import Input, Parameter

#: A measurement beyond is no number either.
LARGEST = 1e9

#: So many numbers up to the last accepted plan's are stale; every other one is a later one's, so
#: that none locks out the next. Numbers count modulo 2³².
STALE_SPAN = 2**16


class Status(IntFlag):
    """What happened in a period; the bits that the C returns."""

    OK = 0
    CLIPPED = 1
    SLEWED = 2
    BRIDGED = 4
    LOST = 8
    SINGULAR = 16
    SWITCHED = 32
    FAULT = 64
    FALLBACK = 128


class PlanAnswer(IntEnum):
    """Answer to an offered plan."""

    ACCEPTED = 0
    BUSY = 1
    STALE = 2
    INVALID = 3
    CORRUPT = 4


#: Headers that the generated C includes: a file of its own under such a name would hide them.
HEADERS = {"math", "signal", "stdio", "stdlib", "simstruc", "fmi3", "unit", "model"}


#: Signs of units and formulas, as words in ASCII have them.
_SPELLED = {"²": "^2", "³": "^3", "·": " ", "Ω": "Ohm", "°": " deg", "×": "x", "≤": "<=", "±": "+-"}


def _letter(sign: str) -> str:
    """Return an ASCII spelling of one letter: Greek by its name, others without accents."""
    if sign.isascii():
        return sign
    *kind, name = unicodedata.name(sign, "unnamed").split()
    if kind[:1] == ["GREEK"] and kind[-1:] == ["LETTER"]:
        return name.lower() if "SMALL" in kind else name.title()
    plain = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode()
    return plain or f"u{ord(sign):x}"


def c_name(name: str) -> str:
    """Return a name in ASCII: what is no letter of C keeps its place in words."""
    return "".join(map(_letter, name))


def macros(parameters: Iterable[Parameter]) -> dict[sp.Symbol, str]:
    """Return C names of parameters: the place makes each one of a kind, its name readable."""
    return {p.symbol: f"UT_PARAMETER_{i}_{c_name(p.name)[:32]}" for i, p in enumerate(parameters)}


def ascii_words(text: str) -> str:
    """Return words in ASCII that neither begin nor end a comment, and hold no trigraph."""
    for sign, words in _SPELLED.items():
        text = text.replace(sign, words)
    plain = "".join(map(_letter, text)).replace("\\", "/")  # first: "*\" would become an end
    return " ".join(re.sub(r"[*](?=/)|/(?=[*])|[?](?=[?])", r"\g<0> ", plain).split())


def at_most(channel: Input) -> str:
    """Return the limit of an input, with its unit where it has one."""
    return f"at most {channel.limit:g} {channel.unit}".rstrip()


def template(name: str, prefix: str = "ut") -> Template:
    """Return a template of C, the names in it with their prefix."""
    source = resources.files("undertow.export") / "templates" / name
    return Template(prefixed(source.read_text(encoding="ascii"), prefix))


def prefixed(text: str, prefix: str) -> str:
    """Give the names of C their prefix."""
    text = re.sub(r"\but_", f"{prefix}_", text)
    return re.sub(r"\bUT_", f"{prefix.upper()}_", text)
