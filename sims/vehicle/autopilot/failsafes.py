"""Failsafes: what is watched, how often, and what is done; each acts once until it has cleared."""

import math
from dataclasses import dataclass
from typing import Literal

from .navigation import Motion
from .parameters import Parameters

GCS_TIMEOUT = 2.5  # s without a message that counts as the ground station's
_FAST, _SLOW = 0.02, 0.3  # s between checks of the pilot's input; of the others
CRITICAL, WARNING = 2, 4  # severities of STATUSTEXT

FailsafeAction = Literal[
    "neutral", "disarm", "hold depth or disarm", "surface or disarm", "surface"
]


@dataclass(frozen=True)
class Text:
    """A STATUSTEXT."""

    severity: int
    text: str


class Failsafes:
    """Flags of what has failed, and the times of what was last heard.

    FS_PILOT_INPUT: 0 nothing, 1 neutral, 2 neutral and disarm. FS_GCS_ENABLE, while armed and once
    a ground station was heard: 2 disarm, 3 hold depth, 4 surface. FS_LEAK_ENABLE 2 and
    BATT_FS_LOW_ACT 3: surface; BATT_FS_LOW_ACT 2: disarm.
    """

    def __init__(self, parameters: Parameters):
        self._parameters = parameters
        self.pilot = self.gcs = self.leak = self.battery = False
        self._pilot_heard = 0.0
        self._gcs_heard: float | None = None
        self._warned = {"gcs": -math.inf, "leak": -math.inf}
        self._low_since: float | None = None
        self._fast_at = self._slow_at = -math.inf
        self.texts: list[Text] = []

    @property
    def any(self) -> bool:
        """Whether any is on: the vehicle then reports MAV_STATE_CRITICAL."""
        return self.pilot or self.gcs or self.leak or self.battery

    def heard_pilot(self, t: float) -> None:
        """Note pilot input, which counts as the ground station's heartbeat as well."""
        self._pilot_heard = self._gcs_heard = t

    def heard_gcs(self, t: float) -> None:
        """Note a heartbeat of the ground station."""
        self._gcs_heard = t

    def step(self, t: float, armed: bool, motion: Motion) -> list[FailsafeAction]:
        """What is to be done at time t."""
        actions: list[FailsafeAction] = []
        if t - self._fast_at >= _FAST - 1e-9:
            self._fast_at = t
            actions += self._check_pilot(t)
        if t - self._slow_at >= _SLOW - 1e-9:
            self._slow_at = t
            actions += self._check_gcs(t, armed)
            actions += self._check_leak(t, armed, motion)
            actions += self._check_battery(t, motion)
        return actions

    def _check_pilot(self, t: float) -> list[FailsafeAction]:
        p = self._parameters
        way = p.integer("FS_PILOT_INPUT")
        if way == 0 or t < self._pilot_heard + p["FS_PILOT_TIMEOUT"]:
            self.pilot = False
            return []
        if self.pilot:
            return []
        self.pilot = True
        self.texts.append(Text(CRITICAL, "Lost manual control"))
        return ["neutral", "disarm"] if way == 2 else ["neutral"]

    def _check_gcs(self, t: float, armed: bool) -> list[FailsafeAction]:
        way = self._parameters.integer("FS_GCS_ENABLE")
        if way == 0 or self._gcs_heard is None:
            return []
        if t - self._gcs_heard < GCS_TIMEOUT:
            if self.gcs:
                self.texts.append(Text(WARNING, "GCS Failsafe Cleared"))
            self.gcs = False
            return []
        if self._due("gcs", t, 30.0):
            self.texts.append(Text(WARNING, "MYGCS: heartbeat lost"))
        if self.gcs or not armed:
            return []
        self.gcs = True
        actions: dict[int, list[FailsafeAction]] = {
            2: ["disarm"],
            3: ["hold depth or disarm"],
            4: ["surface or disarm"],
        }
        return actions.get(way, [])

    def _check_leak(self, t: float, armed: bool, motion: Motion) -> list[FailsafeAction]:
        way = self._parameters.integer("FS_LEAK_ENABLE")
        if not motion.leak or way == 0:
            self.leak = False
            return []
        if self._due("leak", t, 20.0):
            self.texts.append(Text(CRITICAL, "Leak Detected"))
        if self.leak:
            return []
        self.leak = True
        return ["surface"] if way == 2 and armed else []

    def _check_battery(self, t: float, motion: Motion) -> list[FailsafeAction]:
        p = self._parameters
        low = p["BATT_LOW_VOLT"]
        if low <= 0 or motion.voltage >= low:
            self._low_since = None
            return []
        self._low_since = t if self._low_since is None else self._low_since
        if self.battery or t - self._low_since < p["BATT_LOW_TIMER"]:
            return []
        self.battery = True
        self.texts.append(Text(WARNING, f"Battery 1 is low {motion.voltage:.2f}V used 0 mAh"))
        actions: dict[int, list[FailsafeAction]] = {2: ["disarm"], 3: ["surface"]}
        return actions.get(p.integer("BATT_FS_LOW_ACT"), [])

    def _due(self, name: str, t: float, every: float) -> bool:
        due = t - self._warned[name] > every
        if due:
            self._warned[name] = t
        return due
