"""Flies the pylon crossing on served vehicles in real time: success, jitter of the loop, plans.

    .venv/bin/python benchmarks/real_time.py --seeds 20 --faults "loss: 0.01, jitter: 0.03"

Each seed has a simulated vehicle in a process of its own (`spinndrift vehicle`), by UDP on
loopback, so that plant, loop and planner share the cores of this machine. Lateness of the loop, its
jitter, is the time from the instant at which a step is due until it begins; that of a command until
it is sent.
"""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from spinndrift.models.config.errors import UserError
from spinndrift.sims.compile_cache import keep_compiled
from spinndrift.sims.run.flight import fly
from spinndrift.sims.scenarios.scenario import load_scenario


@contextmanager
def served(scenario: str, seed: int, faults: str) -> Iterator[int]:
    """The port of a vehicle served at a free UDP port."""
    command = [sys.executable, "-m", "spinndrift", "vehicle", scenario, "--seed", str(seed)]
    command += ["--connection", "udpin:127.0.0.1:0"]
    command += ["--scenario-text", f"vehicle_server: {{faults: {{{faults}}}}}"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        found = re.search(r"udpin:127.0.0.1:(\d+)", process.stderr.readline())
        if found is None:
            raise UserError("the vehicle was not served; see its message above")
        yield int(found[1])
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30.0)
        process.stderr.close()


def flown(scenario: str, seed: int, faults: str) -> dict[str, Any]:
    """Outcome and numbers of one seed."""
    with served(scenario, seed, faults) as port:
        text = f'vehicle_link: !Mavlink {{connection: "udpout:127.0.0.1:{port}"}}'
        try:
            run = fly(load_scenario(scenario, text).with_changes(seed=seed), arm=True)
        except UserError as error:
            return {"outcome": "refused", "words": str(error)}
    return {"outcome": run.outcome.reason, "words": run.outcome.sentence, **run.numbers}


def main() -> None:
    """Fly all seeds and print a line for each, then the totals."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--scenario", default="pylon_crossing_calm")
    given.add_argument("--seeds", type=int, default=20)
    given.add_argument("--faults", default="", help='of the link: "loss: 0.01, jitter: 0.03"')
    given.add_argument("--out", type=Path, help="JSON file with all numbers")
    options = given.parse_args()
    jax.config.update("jax_enable_x64", True)
    keep_compiled()
    found = []
    with tempfile.TemporaryDirectory() as state:
        os.environ["XDG_STATE_HOME"] = state
        for seed in range(1, options.seeds + 1):
            one = flown(options.scenario, seed, options.faults)
            found.append(one)
            loop, plans = one.get("loop", {}), one.get("plans", {})
            sys.stdout.write(
                f"seed {seed}: {one['outcome']}; loop late by "
                f"{loop.get('lateness_median_ms', 0):.1f} ms (median), "
                f"{loop.get('lateness_p99_ms', 0):.1f} (p99), command by "
                f"{loop.get('command_median_ms', 0):.1f}, {loop.get('command_p99_ms', 0):.1f}; "
                f"{plans.get('made', 0)} plans, "
                f"{plans.get('latency_median_ms', 0):.0f} ms (median), "
                f"{plans.get('latency_p99_ms', 0):.0f} (p99); {one['words']}\n"
            )
            sys.stdout.flush()
    reached = sum(one["outcome"] == "goal" for one in found)
    late = np.array([one["loop"]["lateness_p99_ms"] for one in found if "loop" in one] or [np.nan])
    sys.stdout.write(
        f"{reached} of {len(found)} reached the goal; the loop's lateness, p99 of each: median "
        f"{np.median(late):.1f} ms, largest {late.max():.1f} ms\n"
    )
    if options.out is not None:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
