"""What a story is on disk: the scenario, and the state of each session.

DIR/story.json                   scenario as drawn, seed, states of the sessions, digests, versions
DIR/session-01 ...               sessions; truth/ in each has its true poses, instances and movers
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeInt, ValidationError

from cdpipe.core.errors import InputError
from cdpipe.core.files import read_json, require_format
from cdpipe.core.yamlfile import Settings
from scenarios.schema import Prop, Scenario, Share
from sim.displacement.growth import CREEPING

FORMAT, FORMAT_VERSION = "tunnelcd-story", 1
FEWEST, MOST = 3, 12
Where = Literal["before", "after", "absent"]
_EXPECTED = "a story is what `tunnelcd simulate --sessions 3 ...` writes"


class SessionState(Settings):
    """What the world is like in one session.

    Attributes:
        name: The session's name and folder; it keys all noise of the session.
        plan: The drive of the scenario that it takes, with sensor, platform, odometry and air; also the movers and
            puddles that the scenario gives to one session alone.
        places: Where each prop that changes or ages is: at its place before, at its place after, or absent.
        shares: How much of each surface change has happened, 0 to 1.
    """

    name: Annotated[str, Field(pattern=r"^session-\d\d$")]
    plan: Literal["before", "after"]
    places: dict[str, Where]
    shares: dict[str, Share]


class Story(Settings):
    """A scenario over several sessions.

    Attributes:
        scenario: The scenario as drawn.
        seed: Draws the world, the states and all noise.
        sessions: The states, the first one that of the scenario's before session, the last one that of its after.
        files: SHA-256 of every file that the scenario names.
        digests: SHA-256 of every file of each session without its truth, by session and file.
        versions: What made it.
    """

    scenario: Scenario
    seed: NonNegativeInt
    sessions: Annotated[tuple[SessionState, ...], Field(min_length=FEWEST, max_length=MOST)]
    files: dict[str, str]
    digests: dict[str, dict[str, str]]
    versions: dict[str, str]


def name_session(number: int) -> str:
    """Return the name of the n-th session, 1-based."""
    return f"session-{number:02d}"


def changing_props(scenario: Scenario) -> list[Prop]:
    """Return the props that come, go, move, are loaded away or age."""
    return [prop for prop in scenario.props if prop.change != "none" or prop.aged is not None]


def is_story(folder: Path) -> bool:
    """Tell whether a folder holds a story."""
    return (folder / "story.json").is_file()


def read_story(folder: Path) -> Story:
    """Read DIR/story.json.

    Raises:
        InputError: It is missing or damaged, or its states do not fit its scenario.
    """
    path = folder / "story.json"
    document = read_json(path, _EXPECTED, is_finite=True)
    found = document.pop("format", None), document.pop("format_version", None)
    require_format(path, found, FORMAT, FORMAT_VERSION, "simulate the story again")
    try:
        story = Story.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{path}: damaged: {where}: {first['msg']}: {_EXPECTED}") from error
    for number, state in enumerate(story.sessions, start=1):
        if state.name != name_session(number):
            raise InputError(
                f"{path}: damaged: sessions.{number - 1}.name: expected {name_session(number)}: {_EXPECTED}"
            )
        for mistake in find_mistakes(story.scenario, state):
            raise InputError(f"{path}: damaged: sessions.{number - 1}.{mistake}: {_EXPECTED}")
    return story


def dump_story(story: Story) -> dict[str, Any]:
    """Return what story.json holds."""
    return {"format": FORMAT, "format_version": FORMAT_VERSION, **story.model_dump(mode="json")}


def find_mistakes(scenario: Scenario, state: SessionState) -> Iterator[str]:
    """Yield what contradicts the scenario in the state of a session."""
    props = {prop.name: prop for prop in changing_props(scenario)}
    kinds = {change.name: change.kind for change in scenario.surface}
    for key, found, wanted in (("places", state.places, props), ("shares", state.shares, kinds)):
        if found.keys() != wanted.keys():
            yield f"{key}: expected {', '.join(wanted) or 'nothing'}"
            return
    for name, where in state.places.items():
        if where not in possible_places(props[name]):
            yield f"places.{name} = {where}: its change is {props[name].change}"
    for name, share in state.shares.items():
        if kinds[name] not in CREEPING and share not in (0.0, 1.0):
            yield f"shares.{name} = {share:g}: a {kinds[name]} happens at once: expected 0 or 1"


def possible_places(prop: Prop) -> tuple[Where, ...]:
    """Return where a prop that changes may be in some session."""
    if prop.change == "added":
        return ("absent", "after")
    if prop.change == "removed":
        return ("absent", "before")
    return ("before", "after", "absent") if prop.change == "moved" else ("before", "after")
