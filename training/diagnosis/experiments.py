"""What to measure next, so that names which these data can't tell apart come apart."""

from collections.abc import Sequence

_PAIRS: dict[frozenset[str], str] = {
    frozenset(pair): text
    for pair, text in (
        (("thruster_lag", "actuation_delay"), "chirp one axis from 0.5 to 4 Hz at half effort"),
        (("actuation_delay", "clock_offset"), "tap the hull while it drifts without thrust"),
        (("thruster_dead_zone", "thrust_curve"), "sweep one axis slowly through its full range"),
        (("thruster_dead_zone", "inflow_thrust_loss"), "repeat the same thrust at other speeds"),
        (("thrust_scale", "voltage_sag"), "repeat a run with a full and an empty battery"),
        (("thrust_scale", "added_mass"), "hang a known weight under the vehicle and lift it"),
        (("thrust_asymmetry", "drag_asymmetry"), "coast down from both directions without thrust"),
        (("centre_of_gravity", "payload"), "accelerate up and down: a load also adds inertia"),
        (("net_buoyancy", "payload"), "accelerate along all axes: a load also adds inertia"),
        (("current_steady", "tether"), "hold station at several places and headings"),
        (("current_steady", "net_buoyancy"), "drift freely for a minute"),
        (("current_varying", "disturbance_colour"), "repeat at two depths and several headings"),
        (("dvl_misalignment", "heading_error"), "drive straight lines along four headings"),
        (("quadratic_drag", "cubic_drag"), "drive at full speed and at a tenth of it"),
        (("quadratic_drag", "linear_drag"), "drive at full speed and at a tenth of it"),
        (("drag_coupling", "thruster_gain"), "coast down without thrust"),
    )
}
_ALONE = {
    "actuation": "step each thruster alone from rest to half and to full effort",
    "body": "drive every axis both ways at three speeds, and coast down",
    "environment": "repeat the same commands at other places, depths and headings",
    "disturbance": "record ten minutes without commands",
    "measurement": "drive a square and turn on the spot at each corner",
}


def next_experiment(name: str, family: str, others: Sequence[str]) -> str:
    """A maneuver that tells `name` from the first of `others` for which one is known."""
    for other in others:
        text = _PAIRS.get(frozenset((name, other)))
        if text is not None:
            return f"to tell it from {other}: {text}"
    return _ALONE[family]
