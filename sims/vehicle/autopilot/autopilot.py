"""The autopilot: pilot's input, arming, modes, mixer, failsafes and outputs in one step."""

from .arming import refusal_to_arm
from .channels import Channels
from .failsafes import CRITICAL, WARNING, FailsafeAction, Failsafes, Text
from .mixer import FRAMES, NEUTRAL, Demands, Spool, mix
from .modes import ALT_HOLD, MANUAL, SURFACE, Controller
from .modes import refusal as refusal_of_mode
from .motor_test import MotorTest
from .navigation import Aid, Motion
from .outputs import Outputs
from .parameters import Parameters
from .pilot import ARM, ARM_TOGGLE, DISARM, MODE_BUTTONS, Pilot, Sticks

INFO = 6
READY = 1.7  # s after boot: from here it takes commands
FORCE_ARM, FORCE_DISARM = 2989, 21196
_EKF = ((3.7, "EKF3 IMU0 initialised"), (3.7, "AHRS: EKF3 active"))
_BOOT = (
    (READY, "Barometer 1 calibration complete"),
    (READY, "ArduPilot Ready"),
    *_EKF,
    (5.4, "EKF3 IMU0 tilt alignment complete"),
    (5.4, "EKF3 IMU0 MAG0 initial yaw alignment complete"),
)
ALIGNED = 5.4
_INPUT_PERIOD = 0.02  # s between looks at the overrides
_CONTROL_PERIOD = 0.01  # s between steps of the loops: the motion is not known more often


class Autopilot:
    """An autopilot from its boot at t = 0; `step` advances it.

    Times are seconds since the boot and never go back. What it says to the ground (STATUSTEXT) is
    collected in `texts`, which the caller empties.
    """

    def __init__(self, parameters: Parameters):
        self.parameters = parameters
        self.frame = parameters.integer("FRAME_CONFIG")
        if self.frame not in FRAMES:
            self.frame = 2
        self.motors = len(FRAMES[self.frame].factors)
        self.armed, self.mode = False, MANUAL
        self.motion = Motion()
        self.channels = Channels()
        self.pilot = Pilot(parameters)
        self.outputs = Outputs(parameters)
        self.failsafes = Failsafes(parameters)
        self.motor_test = MotorTest(parameters)
        self.aid = Aid(parameters)
        self.texts: list[Text] = []
        self.t = 0.0
        self._controller = Controller(parameters)
        self._spool = Spool()
        self._boot = list(_BOOT)
        self._input_at = 0.0
        self._demands, self._demands_at = Demands(), 0.0

    # ------------------------------------------------------------------------ from the ground

    def heard(self, system: int) -> bool:
        """Whether `system` is the ground station that may command; its heartbeat is noted."""
        if system != self.parameters.integer("SYSID_MYGCS"):
            return False
        self.failsafes.heard_gcs(self.t)
        return True

    def manual_control(self, system: int, target: int, sticks: Sticks) -> None:
        """Take MANUAL_CONTROL, from the ground station and to this vehicle only."""
        p = self.parameters
        mine = system == p.integer("SYSID_MYGCS") and target == p.integer("SYSID_THISMAV")
        if not mine:
            return
        for action in self.pilot.fly(sticks, self.channels, self.t, self.armed):
            self._press(action)
        self._collect()
        self.failsafes.heard_pilot(self.t)

    def override(self, system: int, values: list[int]) -> None:
        """Take RC_CHANNELS_OVERRIDE of the ground station."""
        if system == self.parameters.integer("SYSID_MYGCS"):
            self.channels.override_all(values, self.t)
            self.failsafes.heard_pilot(self.t)

    def arm(self, force: bool = False) -> bool:
        """Arm; a refusal is told. An armed vehicle accepts."""
        if self.armed:
            return True
        why = None if force else refusal_to_arm(self.parameters, self.motion)
        if why is not None:
            self._tell(CRITICAL, f"Arm: {why}")
            return False
        self._tell(INFO, "Arming motors")
        self.armed = True
        self.outputs.rest(self.t, self.motors)
        self._controller.reset(self.motion)
        return True

    def disarm(self) -> None:
        """Disarm."""
        if self.armed:
            self._tell(INFO, "Disarming motors")
            self.armed = False
            self.pilot.clear_hold()

    def set_mode(self, mode: int) -> bool:
        """Change the mode; a refusal is told."""
        if mode == self.mode:
            return True
        why = refusal_of_mode(mode, self.aid.valid(self.t))
        if why is not None:
            self._tell(WARNING, why)
            return False
        if mode == MANUAL:  # what were angles become thrusts
            self._neutral()
        self.mode = mode
        self._controller.reset(self.motion)
        return True

    def test_motor(self, params: tuple[float | int, ...]) -> bool:
        """Take DO_MOTOR_TEST."""
        accepted = self.motor_test.command(self.t, params, self.armed, self.outputs, self.motors)
        self._collect()
        return accepted

    def set_servo(self, number: int, us: int) -> bool:
        """Take DO_SET_SERVO."""
        done = self.outputs.set_servo(self.t, number, us)
        if not done:
            self._tell(INFO, f"ServoRelayEvent: Channel {number} is already in use")
        return done

    # ------------------------------------------------------------------------------- each step

    def step(self, t: float, motion: Motion) -> list[int]:
        """Advance to time t with what is known of the motion; returns the servo outputs (µs)."""
        dt, self.t, self.motion = max(t - self.t, 1e-6), t, motion
        while self._boot and t >= self._boot[0][0]:
            self._tell(INFO, self._boot.pop(0)[1])
        if t - self._input_at >= _INPUT_PERIOD - 1e-9:
            self._input_at = t
            self.channels.update(t, self.parameters)
        actions = self.failsafes.step(t, self.armed, motion)
        self._collect()
        for action in actions:
            self._do(action)
        if self.motor_test.step(t):
            self._collect()
            self.disarm()
        if not self.motor_test.running:
            self.outputs.step(t, self.channels, self._mixed(dt, motion))
        self._collect()
        return self.outputs.us

    @property
    def status(self) -> int:
        """MAV_STATE: 1 boot, 3 standby, 4 active, 5 critical while any failsafe is on."""
        if self.failsafes.any:
            return 5
        if self.armed:
            return 4
        return 3 if self.t >= READY else 1

    def _mixed(self, dt: float, motion: Motion) -> list[int]:
        if not self.armed:
            self._spool.step(dt, False, self.parameters, 0.0)
            return [NEUTRAL] * self.motors
        since = self.t - self._demands_at
        if self.mode == MANUAL or since >= _CONTROL_PERIOD - 1e-9:
            self._demands_at = self.t
            self._demands = self._controller.step(
                self.mode, since, self.t, self.channels, self.pilot.gain, motion, self.aid
            )
        demands = self._demands
        most = self._spool.step(dt, True, self.parameters, demands.throttle)
        if most is None:
            return [NEUTRAL] * self.motors
        return mix(self.parameters, self.frame, demands, most)

    def _press(self, function: int) -> None:
        if function in MODE_BUTTONS:
            self.set_mode(MODE_BUTTONS[function])
        elif function == ARM or (function == ARM_TOGGLE and not self.armed):
            self.arm()
        elif function in (DISARM, ARM_TOGGLE):
            self.disarm()

    def _do(self, action: FailsafeAction) -> None:
        if action == "neutral":
            self._neutral()
        elif action == "disarm":
            self.disarm()
        else:
            mode = ALT_HOLD if action.startswith("hold depth") else SURFACE
            if not self.set_mode(mode) and action.endswith("or disarm"):
                self.disarm()

    def _neutral(self) -> None:
        self.channels.neutral(self.parameters)
        self.pilot.clear_trim()

    def _tell(self, severity: int, text: str) -> None:
        self.texts.append(Text(severity, text))

    def _collect(self) -> None:
        """Gather what the parts have to say."""
        self.texts += [Text(severity, text) for severity, text in self.motor_test.texts]
        self.texts += self.failsafes.texts
        self.texts += [Text(INFO, text) for text in (*self.pilot.texts, *self.aid.texts)]
        for part in (self.motor_test, self.failsafes, self.pilot, self.aid):
            part.texts.clear()
