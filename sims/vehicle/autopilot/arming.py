"""Why the vehicle refuses to arm."""

from .navigation import Motion
from .parameters import Parameters
from .pilot import ARM_TOGGLE, DISARM, SHIFT

_ALL, _RC, _BATTERY = 1, 1 << 6, 1 << 8  # bits of ARMING_CHECK
_STICKS = {"Roll": 2, "Pitch": 1, "Throttle": 3, "Yaw": 4}
_HIGHEST_MIN, _LOWEST_MAX = 1300, 1700  # µs


def refusal_to_arm(parameters: Parameters, motion: Motion) -> str | None:
    """The first check that fails, as it is told after "Arm: "; None if all pass.

    Checked are a button that disarms, always, and as ARMING_CHECK says the sticks' ranges and the
    battery.
    """
    p = parameters
    if not _can_disarm(p):
        return "Must assign a disarm or arm_toggle button or disarm aux function"
    checks = p.integer("ARMING_CHECK")
    if checks & (_ALL | _RC):
        for name, channel in _STICKS.items():
            if p[f"RC{channel}_MIN"] > _HIGHEST_MIN:
                return f"{name} radio min too high"
            if p[f"RC{channel}_MAX"] < _LOWEST_MAX:
                return f"{name} radio max too low"
    if checks & (_ALL | _BATTERY):
        return _battery(p, motion.voltage)
    return None


def _can_disarm(p: Parameters) -> bool:
    functions = [p.integer(f"BTN{i}_FUNCTION") for i in range(16)]
    if SHIFT in functions:
        functions += [p.integer(f"BTN{i}_SFUNCTION") for i in range(16)]
    return ARM_TOGGLE in functions or DISARM in functions


def _battery(p: Parameters, voltage: float) -> str | None:
    least, low, critical = (p[f"BATT_{name}_VOLT"] for name in ("ARM", "LOW", "CRT"))
    if least > 0 and voltage < least:
        return "Battery 1 below minimum arming voltage"
    if low > 0 and voltage < low:
        return "Battery 1 low voltage failsafe"
    if critical > 0 and voltage < critical:
        return "Battery 1 critical voltage failsafe"
    return None
