"""Scenarios by ASAM's checker of OpenSCENARIO XML, and by scenariogeneration's parser.

Arguments: scenarios. Answer: for each the checks that ran, the issues that they found, the version, the names of the
entities, the number of events, and whether what the parser makes of it is the same scenario again.
"""

import json
import logging
import sys
import xml.etree.ElementTree as ElementTree

from qc_baselib import Configuration, Result
from qc_openscenario import constants
from qc_openscenario.main import run_checks
from scenariogeneration import xosc

logging.disable()


def check(path: str) -> tuple[list[str], list[str]]:
    """Return the ids of the checks that were completed, and what they found."""
    config, result = Configuration(), Result()
    config.set_config_param("InputFile", path)
    result.register_checker_bundle(
        name=constants.BUNDLE_NAME, description="", version=constants.BUNDLE_VERSION, summary=""
    )
    run_checks(config, result)
    checkers = result.get_checker_results(constants.BUNDLE_NAME)
    completed = [each.checker_id for each in checkers if each.status.value == "completed"]
    return completed, [issue.description for each in checkers for issue in each.issues]


rows = []
for path in sys.argv[1:]:
    parsed = xosc.Scenario.parse(ElementTree.parse(path).getroot())
    entities = [each.name for each in parsed.entities.scenario_objects]
    again = xosc.Scenario.parse(parsed.get_element())
    written = parsed.get_element()
    header, events = written.find("FileHeader"), len(list(written.iter("Event")))
    version = [header.get("revMajor"), header.get("revMinor")]
    rows.append([*check(path), version, entities, events, again == parsed])
print(json.dumps(rows))
