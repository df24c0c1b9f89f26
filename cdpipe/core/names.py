"""Names of users and files: as parts of paths, and as text that a terminal or a page shows."""

from __future__ import annotations

import hashlib
import re
import unicodedata

LONGEST = 200  # file systems take names of 255 bytes; suffixes and the marks of unfinished files need the rest
ADDRESS_MARKS = re.compile("[?#%]")
"""What a path may hold that is no part of a name in an address, such as the `file:PATH` of SQLite."""
# Names that Windows keeps for devices, with any suffix.
_DEVICES = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_DIGEST_LENGTH = 16
# Letters and a symbol that are drawn as nothing: fillers of Hangul, and the empty pattern of Braille.
_BLANKS = dict.fromkeys((0x115F, 0x1160, 0x2800), " ")
_SCRIPTS_WITHOUT_MARKS = ("LATIN", "GREEK", "CYRILLIC")
# Marks that are drawn as nothing on any letter: joiners, inherent vowels of Khmer, selectors of variants.
_NO_MARKS = re.compile("[\u034f\u17b4\u17b5\u180b-\u180f\ufe00-\ufe0f\U000e0100-\U000e01ef]")
# Besides numbers, what `pandas.read_csv` takes for something else than a text.
_NO_NAMES = ("na", "n/a", "nan", "none", "null", "true", "false", "1.#ind", "1.#qnan")


def path_part(name: str) -> str:
    """Return a name as one part of a path: ASCII, visible, at most `LONGEST` characters, and valid on every system.

    Other characters than letters, digits and `._=,-` become `_`. A leading or trailing dot and the name of a device get
    a `_` beside it, so that no name is hidden or leads out of its folder. A longer name is cut and ends with its
    digest. Two names may give one part; whoever makes folders from names refuses names that are equal when `folded`.
    """
    part = re.sub(r"[^A-Za-z0-9._=,-]", "_", name)
    if not part or part.startswith(".") or _DEVICES.fullmatch(part):
        part = f"_{part}"
    if part.endswith("."):
        part = f"{part}_"
    if len(part) > LONGEST:
        digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:_DIGEST_LENGTH]
        part = f"{part[: LONGEST - _DIGEST_LENGTH - 1]}-{digest}"
    return part


def folded(name: str) -> str:
    """Return what two names share where they would share a folder; file systems may ignore case."""
    return path_part(name).casefold()


def bare(name: str) -> str:
    """Return what two names share that a reader takes for one: in small letters, without what nobody sees.

    Spaces at the ends, format characters and letters of other widths count as not seen, and so do marks that stand
    on Latin, Greek and Cyrillic letters or on no letter. In other scripts marks are vowels and tones: they stay.
    """
    plain = unicodedata.normalize("NFKC", name).casefold()
    letters: list[str] = []
    keeps_marks = False
    for letter in unicodedata.normalize("NFKC", plain).translate(_BLANKS):
        kind = unicodedata.category(letter)[0]
        if kind == "C" or _NO_MARKS.match(letter):
            continue
        if kind != "M":
            keeps_marks = kind == "L" and not unicodedata.name(letter, "").startswith(_SCRIPTS_WITHOUT_MARKS)
        # the same mark twice is drawn once
        if kind != "M" or (keeps_marks and letters[-1] != letter):
            letters.append(letter)
    return "".join(letters).strip()


def require_name(name: str) -> str:
    """Return a name that a user chose.

    Raises:
        ValueError: It has no letter or digit, is too long for a folder's name, holds a character that is not shown, or
            begins or ends with a space, which a table does not show.
    """
    if not re.search(r"[A-Za-z0-9]", name):
        raise ValueError("expected a name with a letter or a digit of ASCII")
    if len(name) > LONGEST:
        raise ValueError(f"is too long: expected at most {LONGEST} characters")
    if visible(name) != name:
        raise ValueError("expected a name without control characters")
    if name != name.strip():
        raise ValueError("expected a name without spaces at its ends")
    return name


def require_table_name(name: str) -> str:
    """Return a name that a user chose for a column of a table.

    Raises:
        ValueError: As `require_name`; or the name would be read back as a number, a truth value or a missing value, or
            begins as a formula of a spreadsheet does.
    """
    if name.strip("<>#-").casefold() in _NO_NAMES or _is_number(name):
        raise ValueError("expected a name that a table does not read as a number or as missing")
    if require_name(name)[0] in "=+-@":
        raise ValueError(f"expected a name that does not begin with {name[0]}, as a formula of a spreadsheet does")
    return name


def visible(text: str) -> str:
    r"""Return a line of text with everything that is not shown as it is (ESC, newline, bidi marks) as `\x1b`, `\n`."""
    if text.isprintable():
        return text
    return "".join(letter if _is_shown(letter) else letter.encode("unicode_escape").decode() for letter in text)


def _is_shown(letter: str) -> bool:
    return letter.isprintable() or unicodedata.category(letter) == "Zs"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
