"""Names and words of a mechanism in C: ASCII, one of a kind, harmless in a comment."""

from __future__ import annotations

import re
import unicodedata

__all__ = ["HEADERS", "ascii_words", "c_name", "macro"]

#: Headers that the generated C includes: a file of its own under such a name would hide them.
HEADERS = {"math", "signal", "stdio", "stdlib"}


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


def macro(index: int, name: str) -> str:
    """Return the C name of a parameter: its place makes it one of a kind, its name readable."""
    return f"UT_PARAMETER_{index}_{c_name(name)[:32]}"


def ascii_words(text: str) -> str:
    """Return words in ASCII that neither begin nor end a comment, and hold no trigraph."""
    for sign, words in {"²": "^2", "³": "^3", "·": " ", "Ω": "Ohm"}.items():
        text = text.replace(sign, words)
    plain = "".join(map(_letter, text)).replace("\\", "/")  # first: "*\" would become an end
    return " ".join(re.sub(r"[*](?=/)|/(?=[*])|[?](?=[?])", r"\g<0> ", plain).split())
