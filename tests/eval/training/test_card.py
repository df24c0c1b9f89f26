from eval.training.dataset_card import card


def test_names_do_not_leave_their_place_in_the_card() -> None:
    bad = "a|b\n# c <img src=x> `d`"
    row = {"family": bad, "seed": 1, "status": "refused", "reason": bad}
    made = {"family": bad, "seed": 2, "status": "ok", "split": "train", "shard": "s", "sha256": "0", "bytes": 1}
    made |= dict.fromkeys(("n_before", "n_covered", "n_positive", "n_negative", "n_changes", "n_observable"), 1)
    text = card([row, made], {"settings": [], "draws": 1, "error_m": 0.0, "error_deg": 0.0}, [])
    assert "<img" not in text
    shown = r"a\|b\n# c &lt;img src=x> \`d\`"
    assert text.count(shown) == 4 and "\n# c" not in text
