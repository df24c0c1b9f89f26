"""Every package of an extra is recorded, and a run of an earlier version, which recorded fewer, goes on."""

import tomllib
from contextlib import nullcontext
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from cdpipe.core.errors import InputError
from eval.core import provenance
from eval.running.runfolder import keep_makers
from eval.running.scaling.merged_provenance import resume_provenance, unite_provenance

NOW = provenance.describe_run({"seeds": [1]}, {}, {}, ["run"], None, "")


def test_every_package_of_an_extra_is_classed() -> None:
    text = (Path(__file__).parents[3] / "pyproject.toml").read_text(encoding="utf-8")
    extras = tomllib.loads(text)["project"]["optional-dependencies"]
    of_users = [lines for name, lines in extras.items() if name not in ("test", "dev")]
    named = {Requirement(line).name for lines in of_users for line in lines}
    classed = [*provenance._PACKAGES, *provenance._OF_RECORDINGS, *provenance.IDLE]
    assert named <= set(classed)
    assert sorted(classed) == sorted({*NOW["versions"], *NOW["extras"]} - {"python"})


def test_workers_agree_on_what_rows_depend_on() -> None:
    assert {"genz-icp", "ouster-sdk", "laspy"} <= set(provenance.versions())
    assert not {"rerun-sdk", "viser", "mlcroissant"} & set(provenance.versions())


def test_a_run_of_an_earlier_version_goes_on() -> None:
    earlier = {**NOW, "versions": {**NOW["versions"], "plotly": "7", "viser": "none"}}
    del earlier["extras"], earlier["versions"]["warp-lang"]
    assert resume_provenance("run", earlier, NOW)["extras"] == NOW["extras"]
    with pytest.raises(InputError, match=r"numpy: '1\.0' and "):
        resume_provenance("run", {**earlier, "versions": {**earlier["versions"], "numpy": "1.0"}}, NOW)


def test_extras_count_where_rows_depend_on_them() -> None:
    for name, is_refused in (("rerun-sdk", False), ("mcap", False), ("genz-icp", True), ("laspy", True)):
        earlier = {**NOW, "extras": {**NOW["extras"], name: "0.0"}}
        with pytest.raises(InputError, match=f"{name}: '0.0' and ") if is_refused else nullcontext():
            resume_provenance("run", earlier, NOW)


def test_each_run_is_compared_with_each_other() -> None:
    older = {name: value for name, value in NOW.items() if name != "extras"}  # it agrees with both
    told = [{**older, "started": "1"}, *({**NOW, "started": "1", "extras": {"genz-icp": each}} for each in ("1", "2"))]
    with pytest.raises(InputError, match=r"^b and c: of different .*genz-icp: '1' and '2'"):
        unite_provenance(["a", "b", "c"], told, "merge-runs")
    assert unite_provenance(["a", "b"], told[:2], "merge-runs")[0]["parts"]


def test_each_machine_is_named_once_however_often_a_run_goes_on() -> None:
    one, other = ({**NOW, "machine": {**NOW["machine"], "cpu": cpu, "cores": n}} for cpu, n in (("a", 2), ("b", 4)))
    found = resume_provenance("run", one, other)
    for now in (one, other, other):
        found = resume_provenance("run", found, now)
        assert (found["machine"]["cpu"], found["machine"]["cores"]) == ("a and b", "2 and 4")
    united, _ = unite_provenance(["x", "y"], [{**each, "started": "1"} for each in (found, other)], "merge-runs")
    assert united["machine"] == found["machine"]


def test_packages_of_today_did_not_make_the_cells_of_an_earlier_run() -> None:
    older = {name: value for name, value in NOW.items() if name != "extras"}
    assert "extras" not in keep_makers(NOW, older)
    assert keep_makers(NOW, {**NOW, "extras": {"laspy": "0"}})["extras"] == {"laspy": "0"}
    assert keep_makers(NOW, {})["extras"] == NOW["extras"]
