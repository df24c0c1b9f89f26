"""Names in a view are text: viser reads its panel as Markdown with HTML."""

from dataclasses import replace
from html import unescape

import numpy as np

from sim.view.view import View
from sim.view.viewer import _legend, markdown_text

HOSTILE = "<img src=x onerror=alert(1)> ![a](http://x) [b](javascript:c) {d} `e` **f** | \x1b[2J _g_ \\ #h"


def test_no_name_is_markup() -> None:
    text = markdown_text(HOSTILE)
    assert all(letter.isalnum() or letter in " &#;" for letter in text)
    assert unescape(text) == HOSTILE.replace("\x1b", r"\x1b")
    assert markdown_text("narrow 7") == "narrow 7"


def test_the_panel_of_a_view() -> None:
    nothing = np.zeros(3)
    view = View("plain", (), (), (), (), (), nothing, nothing)
    legend = _legend(replace(view, title=HOSTILE, notes=(HOSTILE,)))
    assert legend == f"**{markdown_text(HOSTILE)}**\n\n{markdown_text(HOSTILE)}"
