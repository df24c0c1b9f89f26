"""What is said of a grafted pair when it is written."""

from __future__ import annotations

from typing import Any

from sim.session.truth import PairTruth, SurfaceChangeTruth

_SPLITS = {
    "passes": "two passes of one way",
    "halves": "the two halves of one recording",
    "alternate": "every other revolution of one recording, from the same places",
    "two recordings": "two recordings",
}
_MERGES = {"given": "merge as given", "tunnelcd": "merge as `tunnelcd` found it", "one recording": "one frame"}

_NOTHING = (
    "nothing is grafted: a real pair without changes",
    "nothing is grafted, and the pair is taken as unchanged: what did change between the recordings is a false alarm",
)


def tell_pair(truth: PairTruth) -> list[str]:
    """Return lines about a grafted pair: where it is from, what is in it, and how noisy the recording is."""
    graft = truth.graft or {}
    lines = [f"sessions: {_SPLITS[graft['split']]}, {_MERGES[graft['merge_from']]}"]
    lines += [_tell_rock(rock, each) for rock, each in zip(truth.surface_changes, graft.get("rock", ()), strict=True)]
    observable = sum(change.is_observable for change in truth.changes)
    if not graft["props"]:
        return lines if graft.get("rock") else [*lines, _NOTHING[len(graft["recordings"]) > 1]]
    replaced, grafted, lost = (sum(each[key] for each in graft["returns"]) for key in ("replaced", "grafted", "lost"))
    changes = "1 change" if len(truth.changes) == 1 else f"{len(truth.changes)} changes"
    lines.append(f"{changes}, {observable} observable; {grafted} returns of props, {lost} lost")
    lines.append(f"{replaced} recorded returns replaced or in a shadow")
    return [*lines, *(_tell_noise(noise) for noise in graft["noise"][: len(graft["recordings"])])]


def _tell_rock(rock: SurfaceChangeTruth, told: dict[str, Any]) -> str:
    """Return what a rock change amounts to, and how many returns of the after session it moved."""
    sizes = f"{rock.area_m2:.1f} m2, {1000 * rock.largest_m:+.0f} mm at most, {rock.volume_m3:+.3f} m3"
    left = f"{told['left'][1]} too flat, hidden or off the rock and left" if told["left"][1] else "none left"
    return f"{rock.kind} {rock.name!r}: {sizes}; {told['moved'][1]} returns moved, {left}"


def _tell_noise(noise: dict[str, list[float]]) -> str:
    """Return the noise of a recording at the ranges where most was measured."""
    counts = noise["n_residuals"]
    edges = [0.0, *noise["edges_m"], float("inf")]
    best = sorted(sorted(range(len(counts)), key=lambda number: -counts[number])[:3])
    told = [
        f"{1000 * noise['sigma_m'][number]:.0f} mm at {edges[number]:g}-{edges[number + 1]:g} m"
        for number in best
        if counts[number]
    ]
    lost = (
        "beams without a return are not recorded"
        if not any(noise["n_gaps"])
        else (f"{100 * max(noise['lost'][number] for number in best):.1f} % lost")
    )
    return f"noise of the recording: {', '.join(told)}; {lost}"
