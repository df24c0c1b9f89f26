from .catalogue import prop_names, scenario_names
from .library import check_scenario, load_scenario
from .references import file_digests
from .schema import Scenario

__all__ = [
    "Scenario",
    "check_scenario",
    "file_digests",
    "load_scenario",
    "prop_names",
    "scenario_names",
]
