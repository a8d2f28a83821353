"""Heartbeats: ours, and what others' say about their senders."""

from .dialect import Message, mavlink


def ours() -> Message:
    """That of a ground station."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_GCS,
        mavlink.MAV_AUTOPILOT_INVALID,
        0,
        0,
        mavlink.MAV_STATE_ACTIVE,
        3,
    )


def is_station(heartbeat: Message) -> bool:
    """Whether its sender is a ground station."""
    return heartbeat.type == mavlink.MAV_TYPE_GCS


def is_autopilot(heartbeat: Message) -> bool:
    """Whether its sender is an autopilot."""
    ground = heartbeat.type in (mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ONBOARD_CONTROLLER)
    return heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and not ground
