"""A change as truth has it, for tests that ask nothing of most of its fields."""

from dataclasses import replace

import numpy as np

from sim.session.truth import Change


def change(number: int, session: str = "after", kind: str = "added", **fields: object) -> Change:
    """Make an observable box with ten returns in ten cells, at the origin; `fields` say what is different."""
    box = Change(
        id=number,
        name=f"thing {number}",
        prop_kind="box",
        kind=kind,
        session=session,
        partner=None,
        group="full",
        instance=number,
        world_T_object=np.eye(4).tolist(),
        hull_volume_m3=1.0,
        n_returns=10,
        n_cells=10,
        n_ghost_rays=10,
        is_observable=True,
        why_not="",
    )
    return replace(box, **fields)
