"""The vehicle's driver: from a connection to an armed vehicle that follows wrenches, and back.

It joins link, parameters, actuation and guards. The order of a dive is `connect`, `preflight`,
`prepare`, then `sense` and `act` in the loop, and `stop` at its end, whatever the reason.
"""

import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ...models.config.errors import UserError
from ...models.thrusters import Thrusters
from . import commands, telemetry
from .actuation import Command, as_wired, make_actuation
from .codec import NEUTRAL_US
from .config import Mavlink
from .dialect import mavlink
from .guard_process import Guard, stop_thrusters
from .link import Link
from .parameters import Borrowed, Parameters, borrowed_file
from .preflight import Finding, Requirements, for_dive, is_depth_healthy, preflight, told
from .safety import Snapshot, State, Supervisor
from .telemetry import Sensed, sensed
from .transport import Connection

_SETTLE = 2.5  # s over which rates are counted before the pre-flight check
_ALIKE = 12.0  # µs by which outputs may differ from commanded ones: whole numbers on three axes
_DELAY = 0.5  # s: the longest time in which a command shows in SERVO_OUTPUT_RAW
_HOLD = "ALT_HOLD"
_FLY = "MANUAL"


class Acted(NamedTuple):
    """What was done with a wrench."""

    order: str
    F_Bo_B: Float[np.ndarray, "6"]
    """The wrench that was sent, within the limits (N, N·m)."""
    expected: Float[np.ndarray, " n"]
    """Outputs that the vehicle will show (µs)."""
    reason: str
    """Why the dive has ended; empty while it goes on."""
    tripped: str = ""
    """Name of the guard that ended it."""
    ages: Mapping[str, float] = {}
    """Those that the guards have seen (s)."""


class Driver:
    """A connected vehicle; a context manager that stops it and closes the link.

    Nothing is armed or changed before `prepare`; with `dry_run` nothing is commanded at all.
    """

    def __init__(
        self,
        config: Mavlink,
        thrusters: Thrusters,
        *,
        density: float = 1025.0,
        dry_run: bool = False,
        record: Path | None = None,
    ):
        """Connect, find the vehicle, read its parameters and ask for its streams.

        `density` is that of the water (kg/m³), `record` a telemetry log (.tlog) to write.

        Raises:
            UserError: there is no vehicle there, or it has another frame than the thrusters'.
        """
        self.config, self._thrusters = config, thrusters
        self._density, self._dry = density, dry_run
        connection = Connection.parse(config.connection, "vehicle_link.connection")
        self.link = Link(connection, system=config.system, record=record)
        try:
            self.vehicle = self.link.find_vehicle()
            self._identity = commands.identity(self.link)
            self._parameters = Parameters(self.link)
            self._read_vehicle()
            rates = telemetry.STREAMS | {"RAW_IMU": config.imu_rate}
            self.refused = commands.request_rates(self.link, rates)
            self.dvl = None if config.dvl is None else config.dvl.open()
        except BaseException:
            self.link.close()
            raise
        self._borrowed = Borrowed(
            self._parameters, borrowed_file(connection, self._identity.serial_number)
        )
        self._guard: Guard | None = None
        self.use(config)
        self._state: State | None = None
        self._ended = ""
        self._sent: deque[tuple[float, np.ndarray]] = deque()
        self._unlike_since: float | None = None

    def use(self, config: Mavlink) -> None:
        """Take the guards' limits of `config` from now on."""
        safety = config.safety
        if config.actuation == "thruster_passthrough":
            safety = replace(safety, end="disarm")  # no mode of the autopilot reaches the thrusters
        self._supervisor = Supervisor(safety)

    def __enter__(self) -> "Driver":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    @property
    def thrusters(self) -> int:
        """Number of thrusters."""
        return self._thrusters.positions.shape[1]

    # ------------------------------------------------------------------------------ before a dive

    def requirements(self) -> Requirements:
        """What the dive needs."""
        rates = {"ATTITUDE_QUATERNION": 20.0, "SERVO_OUTPUT_RAW": 5.0}
        if self.config.estimate == "own":
            rates["RAW_IMU"] = 20.0
        else:
            rates["LOCAL_POSITION_NED"] = 5.0
        return Requirements(
            self.thrusters,
            self.config.actuation == "thruster_passthrough",
            rates,
            self.config.system,
            self.config.safety.min_voltage,
            for_dive(self.parameters, self.config.system),
            self._dry,
        )

    def preflight(self) -> list[Finding]:
        """The checks before arming; waits until rates can be counted.

        Parameters that a former run left changed are given back, unless somebody has armed.
        """
        if self.link.clock.reboots != self._boots:
            self._read_vehicle()
        if not self._seen().armed:
            self.restore()
        time.sleep(_SETTLE)
        given_back = not self._borrowed.left_over
        facts = told(self.link, self.parameters, self._identity.version, given_back)
        return preflight(self.requirements(), facts)

    def _read_vehicle(self) -> None:
        self._boots, self.parameters = self.link.clock.reboots, self._parameters.read_all()
        actual, self._mirrored = as_wired(self._thrusters, self.parameters)
        self._actuation = make_actuation(self.config.actuation, actual, self.parameters)

    def as_described(self, pwm: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Outputs (µs) with the signs of the scenario's vehicle, not of MOT_n_DIRECTION."""
        return NEUTRAL_US + self._mirrored * (pwm - NEUTRAL_US)

    def restore(self) -> dict[str, float]:
        """Give back parameters that a former run left changed; what was restored.

        Raises:
            VehicleRefused: a value can't be restored.
        """
        restored = self._borrowed.give_back()
        self.parameters = {**self.parameters, **restored}
        return restored

    def prepare(self) -> None:
        """Set the failsafes, take the mode MANUAL, start the guard process, arm.

        Parameters are saved to disk before the first is changed.

        Raises:
            VehicleRefused: the vehicle refuses a step, with its reason; what was changed is
                restored.
        """
        # compile before arming: in the loop a pause of a second counts as hanging
        self._actuation.command(self.vehicle, np.zeros(6), 15.0, 1.0)
        if self._dry:
            return
        changed = {
            **for_dive(self.parameters, self.config.system),
            **{
                name: value
                for name, value in self._actuation.borrowed.items()
                if self.parameters.get(name) != value
            },
        }
        try:
            commands.set_mode(self.link, _FLY)
            self._guard = Guard(self.link.connection, self.config.system, self._borrowed.path)
            self._guard.busy()
            # overrides of old may be at work: before pass-through follows them, and before arming
            self._neutral(0.2)
            self._borrowed.borrow(changed, lambda: self._neutral(0.06))
            self._neutral(0.2)
            self._check_untouched(armed=False)
            commands.arm(self.link)
            self._check_untouched(armed=True)
        except BaseException:
            self.stop()
            raise

    def _check_untouched(self, armed: bool) -> None:
        """Check that nobody has taken the vehicle, which is left alone then unless we armed it."""
        if self.link.clock.reboots != self._boots:
            again = "the vehicle has booted anew since its checks; start the run again"
            raise commands.VehicleRefused(f"arming: {again}")
        status = self._seen()
        other = "" if status.mode == _FLY else f"the mode was changed to {status.mode}"
        if status.armed and not armed:
            other = "somebody else has armed the vehicle"
        if other:
            self._ended = self._ended if armed else "yield"
            raise commands.VehicleRefused(f"arming: {other} meanwhile; the dive is left to a pilot")

    def _seen(self) -> telemetry.Status:
        status = telemetry.status(self.link, time.monotonic())
        assert status is not None, "a vehicle is found by its heartbeat"
        return status

    def idle(self) -> None:
        """Send neutral to a vehicle that we have armed: while it waits its failsafe wants to hear.

        Before `prepare` nothing is sent.
        """
        if self._guard is not None:
            self.link.send(self._actuation.neutral(self.vehicle))

    # ------------------------------------------------------------------------------ in the loop

    def sense(self) -> Sensed:
        """The newest readings; does not wait."""
        return sensed(self.link, self.parameters, self._density, self.thrusters)

    def act(
        self,
        t: float,
        F_Bo_B: Float[np.ndarray, "6"],
        p_WBo: Float[np.ndarray, "3"],
        health: int = 0,
        ages: Mapping[str, float] | None = None,
    ) -> Acted:
        """Send a wrench if the guards allow it, or end the dive; does not wait.

        `t` is the time of the dive (s), `p_WBo` and `health` those of the estimate, `ages` those of
        `aid`, `plan`, `loop` and `dead_man` where there is one (s).
        """
        if self._state is None:
            self._state = State(_FLY, np.asarray(p_WBo, float))
        snapshot = self._snapshot(t, np.asarray(F_Bo_B, float), p_WBo, health, ages or {})
        decision = self._supervisor.step(self._state, snapshot)
        self._state = decision.state
        if self._guard is not None:
            self._guard.beat()
        volts = telemetry.battery(self.link)
        volts = float(self._thrusters.nominal_voltage) if np.isnan(volts) else volts
        gain = telemetry.pilot_gain(self.link, self.parameters)
        command = self._actuation.command(self.vehicle, decision.F_Bo_B, volts, gain)
        self._carry_out(decision.order, command)
        self._sent.append((time.monotonic(), command.pwm))
        state = decision.state
        return Acted(
            decision.order, decision.F_Bo_B, command.pwm, state.reason, state.tripped, snapshot.ages
        )

    def _carry_out(self, order: str, command: Command) -> None:
        status = telemetry.status(self.link, time.monotonic())
        held = self._ended == "hold_depth" and not self._dry
        if held and status is not None and not (status.armed and status.mode == _HOLD):
            order = "yield"  # a pilot has taken the vehicle from its depth
        if order == "yield" or self._ended == "yield":
            if self._guard is not None and self._ended != "yield":
                self._guard.pilot()
            self._ended = "yield"
            return
        if self._dry:
            self._ended = "" if order in ("fly", "neutral") else order
            return
        if order == "fly":
            self.link.send(command.message)
            return
        self.link.send(self._actuation.neutral(self.vehicle))
        if order == "hold_depth" and self._ended != order:
            number = float(commands.mode_number(_HOLD))
            self._ask(mavlink.MAV_CMD_DO_SET_MODE, 1.0, number)
        elif order == "disarm" and self._ended != order:
            self._ask(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, commands.FORCED_DISARM)
        if status is not None and (
            (order == "hold_depth" and status.mode == _HOLD)
            or (order == "disarm" and not status.armed)
        ):
            self._ended = order  # seen; until then it is asked for again with every command

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do: disarmed, or a pilot steers."""
        return self._ended in (("hold_depth",) if self._dry else ()) + ("yield", "disarm")

    def dvl_state(self) -> tuple[float, bool]:
        """Age of the newest reading of the DVL (s), infinite without one, and its validity."""
        if self.dvl is not None:
            newest = self.dvl.newest
            return self.dvl.age(), newest is not None and newest.reading.valid
        found = telemetry.dvl(self.link, self.parameters)
        if found is None:
            return float("inf"), False
        return time.monotonic() - found.arrival, bool(found.value[3])

    def _ask(self, command: int, *parameters: float) -> None:
        self.link.send(commands.command_long(self.vehicle, command, *parameters))

    def _snapshot(
        self,
        t: float,
        F: np.ndarray,
        p: np.ndarray,
        health: int,
        ages: Mapping[str, float],
    ) -> Snapshot:
        link, now = self.link, time.monotonic()
        status = telemetry.status(link, now)
        depth = link.age(telemetry.depth_message(link))
        attitude = min(link.age(name) for name in ("ATTITUDE_QUATERNION", "ATTITUDE"))
        seen = {"vehicle": link.silence, "attitude": attitude, "depth": depth, **ages}
        leak = "a leak is reported" if status is not None and status.leak else ""
        system = link.latest("SYS_STATUS")
        sensors = None if system is None else int(system.message.onboard_control_sensors_health)
        # in a dry run the vehicle stays as it is
        armed = self._dry or (status is not None and status.armed)
        mode = _FLY if self._dry or status is None else status.mode
        return Snapshot(
            t,
            F,
            np.asarray(p, float),
            health,
            seen,
            armed,
            mode,
            telemetry.battery(link),
            leak,
            len(link.others(2.0)),
            self._unlike(now),
            sensors is None or is_depth_healthy(sensors),
        )

    def _unlike(self, now: float) -> float:
        """Time for which outputs have not been those commanded within the delay before (s)."""
        shown = telemetry.outputs(self.link, self.thrusters)
        while len(self._sent) > 1 and self._sent[1][0] < now - _DELAY:
            self._sent.popleft()
        if self._dry or shown is None or not self._sent:
            return 0.0
        apart = min(float(np.abs(pwm - shown.value).max()) for _, pwm in self._sent)
        if apart <= _ALIKE:
            self._unlike_since = None
            return 0.0
        self._unlike_since = now if self._unlike_since is None else self._unlike_since
        return now - self._unlike_since

    # ------------------------------------------------------------------------------ after a dive

    def stop(self) -> None:
        """Neutral thrusters, disarm, give parameters back, close; may be called twice.

        A vehicle that a pilot has taken gets its parameters back and is left alone otherwise.

        Raises:
            UserError: the vehicle did not confirm; the guard process then takes over.
        """
        failed: list[str] = []
        if self._guard is not None:
            with suppress(UserError):  # it is gone: stop all the same
                self._guard.busy()
            failed = stop_thrusters(self.link, self._borrowed.path, self._ended == "yield")
        if self.dvl is not None:
            self.dvl.close()
        self.link.close()
        if self._guard is not None:
            (self._guard.leave if failed else self._guard.release)()
            self._guard = None
        if failed:
            raise UserError(f"the vehicle could not be stopped in order: {'; '.join(failed)}")

    def _neutral(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.link.send(self._actuation.neutral(self.vehicle))
            time.sleep(0.05)
