"""Every method and column has an entry, and settings over a method belong to it."""

from cdpipe.model.config import preset_files
from eval.report.framing.glossary import describe_columns, describe_methods, index_entries
from eval.tables.columns import Column, share


def test_every_shipped_preset_is_described_in_whole_sentences() -> None:
    for entry in describe_methods(preset_files()):
        ((meaning, _),) = entry.meanings
        assert len(meaning) > 30 and not meaning.startswith("No preset") and len(meaning) < 600


def test_settings_belong_to_their_method_and_oracles_say_what_they_are_told() -> None:
    variants = ["paper", "paper[query.radius_m=3]", "oracle-merge+oracle-regions", "mine"]
    entries = describe_methods(variants)
    assert [entry.name for entry in entries] == ["paper", "oracle-merge+oracle-regions", "mine"]
    assert [entry.is_oracle for entry in entries] == [False, True, False]
    ((told, _),) = entries[1].meanings
    assert "takes the merge from the truth and takes the regions from the truth" in told
    found = index_entries(entries, [], variants)
    assert found["paper [query.radius_m=3]"] is found["paper"] is entries[0]


def test_columns_of_one_heading_share_an_entry_with_each_meaning() -> None:
    meanings = {"a": "of A", "b": "of B", "c": "of A"}
    columns = [Column(key, "recall", "high", share, meaning) for key, meaning in meanings.items()]
    (entry, more) = describe_columns(columns, [("t", "time", "")])
    assert entry.meanings == (("of A", columns[0].when_undefined), ("of B", columns[0].when_undefined))
    assert (more.name, more.meanings, more.id) == ("t", (("time", ""),), "c2")
