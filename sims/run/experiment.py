"""The maneuvers that a diagnosis wants flown next."""

import json
from pathlib import Path
from typing import Any

from ...models.config.errors import UserError
from ...training.diagnosis.findings.experiments import NOTHING
from ..scenarios.maneuvers import UNFLOWN, check_maneuver
from .before_flight import Tell

_FILE = "diagnosis.json"


def chosen_maneuvers(given: tuple[str, ...], say: Tell = lambda text: None) -> tuple[str, ...]:
    """Names of maneuvers, each given as such or by the file of a diagnosis or its folder.

    Raises:
        UserError: a name is unknown, a file is no diagnosis, or no maneuver helps it.
    """
    found: list[str] = []
    for one in given:
        path = Path(one)
        if path.suffix == ".json" or path.is_dir():
            found += next_experiments(path / _FILE if path.is_dir() else path, say)
        else:
            check_maneuver(one)
            found.append(one)
    return tuple(dict.fromkeys(found))


def next_experiments(path: Path, say: Tell = lambda text: None) -> list[str]:
    """For each cause of a diagnosis the most informative maneuver that can be flown.

    Raises:
        UserError: the file is no diagnosis, or no maneuver helps it.
    """
    found, words = [], []
    for cause in _causes(path):
        told = f"{cause['name']}: {cause['next_experiment']}"
        nats = {name: value for name, value in cause["experiments"].items() if value >= NOTHING}
        order = sorted(nats, key=lambda name: -nats[name])
        names = [name for name in order if name not in UNFLOWN]
        words.append(told)
        if not names:
            continue
        say(told)
        if names[0] != order[0]:
            say(
                f"{order[0]} can't be flown here ({UNFLOWN[order[0]]}); the next best is "
                f"{names[0]} ({nats[names[0]]:.2g} nats a minute)"
            )
        check_maneuver(names[0])
        found.append(names[0])
    if not found:
        told = "; ".join(words) or "it names no cause"
        raise UserError(f"--maneuver {path}: no maneuver helps this diagnosis: {told}")
    return found


def _causes(path: Path) -> list[dict[str, Any]]:
    """Causes of a diagnosis' file, with their experiments."""
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        causes = [
            {
                "name": str(cause["name"]),
                "next_experiment": str(cause["next_experiment"]),
                "experiments": {
                    str(name): float(value)
                    for name, value in cause["experiments"].items()
                    if value is not None
                },
            }
            for cause in told["causes"]
        ]
    except FileNotFoundError as error:
        raise UserError(
            f"--maneuver {path}: no such file; give a maneuver's name, or a diagnosis"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"--maneuver {path}: is no diagnosis.json, which spinndrift diagnose writes; name "
            "another file"
        ) from error
    return causes
