from __future__ import annotations

from collections.abc import Callable

from sim.studies.timing import raced, timed


class Machine:
    """A clock that only work moves on; remembers who worked."""

    def __init__(self) -> None:
        self.now = 0.0
        self.calls: list[str] = []

    def worker(self, name: str, seconds: list[float]) -> Callable[[], None]:
        left = list(seconds)

        def work() -> None:
            self.calls.append(name)
            self.now += left.pop(0)

        return work


def test_the_first_call_does_not_count() -> None:
    machine = Machine()
    assert timed(machine.worker("a", [9.0, 1.0, 2.0]), 2, lambda: machine.now) == (1.0, 2.0)


def test_rivals_take_turns_and_keep_their_own_times() -> None:
    machine = Machine()
    ours, theirs = machine.worker("a", [9.0, 1.0, 2.0, 3.0]), machine.worker("b", [8.0, 10.0, 20.0, 30.0])
    assert raced(ours, theirs, 3, lambda: machine.now) == ((1.0, 2.0, 3.0), (10.0, 20.0, 30.0))
    # Neither always runs right after the other.
    assert "".join(machine.calls) == "ab" + "ab" + "ba" + "ab"
