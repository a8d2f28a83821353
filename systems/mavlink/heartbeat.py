"""Heartbeats: ours, and what others' say about their senders."""

import os

from .dialect import Message, mavlink

COMPONENT = mavlink.MAV_COMP_ID_USER1 + os.getpid() % 75
"""Our component, in MAVLink's range for users.

An autopilot passes a ground station's heartbeat on to its other links, but not to one where it
knows the same system and component: with the usual 190 a rival of our system id would stay unseen.
"""


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
