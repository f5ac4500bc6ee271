"""The command ``batch``: calibrate many recordings."""

from typing import Any

from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.offline.cli.jobs import Job

_BRIEF = """\
BAG:
  fleet/                   a folder: all bags below it
  'fleet/*/drive'          a pattern of bags, in quotes

most used options:
  --vehicle PATTERN        'fleet/{vehicle}/*': recordings of one vehicle become one result
  --parent-topic, --child-topic TOPIC   pose topics of each bag
  --out DIR                save all results, a table and a page of all
  --no-report              omit the page of each recording: much faster
  --jobs N                 worker processes. Default: one for each core

examples:
  hand_eye_calib batch fleet/ --out results
  hand_eye_calib batch 'fleet/**' --vehicle 'fleet/{vehicle}/' --out results --jobs 4"""


def _prepare(arguments: Any) -> None:
    if not arguments.paths:
        raise ConfigError(
            "batch needs bags, folders or patterns of bags: batch fleet/ --out DIR"
        )
    arguments.batch = [*map(str, arguments.paths), *(arguments.batch or ())]
    arguments.paths = []


BATCH = Job("[OPTION ...] BAG ...", _BRIEF, _prepare)
