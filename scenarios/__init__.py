"""What the world is: the schema of a scenario, and the families that come with the package."""

from scenarios.library import check_scenario, load_scenario, scenario_names

__all__ = ["check_scenario", "load_scenario", "scenario_names"]
