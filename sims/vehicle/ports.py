"""All MAVLink ports of a vehicle as byte streams: packing, parsing and routing between them."""

from ...systems.mavlink.dialect import Message, Parser, mavlink
from .endpoint import COMPONENT, Endpoint
from .vehicle import Vehicle

DVL_COMPONENT = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
_LONGEST_TEXT = 50


class Ports:
    """The ports of a vehicle, counted from 0.

    What arrives at one port and is not for this vehicle alone goes out at the others, as an
    autopilot routes it: broadcasts to all, the rest to where its target was heard.
    """

    def __init__(self, vehicle: Vehicle, count: int):
        self.vehicle = vehicle
        system = vehicle.parameters.integer("SYSID_THISMAV")
        self._system = system
        self.parsers = [Parser(system, COMPONENT) for _ in range(count)]
        self.endpoints = [Endpoint(vehicle) for _ in range(count)]
        self._dvl = Parser(system, DVL_COMPONENT)
        self._heard: list[set[int]] = [set() for _ in range(count)]
        self._waiting: list[list[bytes]] = [[] for _ in range(count)]
        self._boots = vehicle.boots

    def receive(self, port: int, data: bytes) -> None:
        """Take bytes that arrived at a port."""
        for message in self.parsers[port].messages(data):
            self._heard[port].add(message.get_srcSystem())
            self.endpoints[port].handle(message)
            self._route(port, message)

    def _route(self, port: int, message: Message) -> None:
        target = getattr(message, "target_system", 0)
        if target == self._system:
            return
        for other, waiting in enumerate(self._waiting):
            if other != port and (target == 0 or target in self._heard[other]):
                waiting.append(bytes(message.get_msgbuf()))

    def dvl(self, messages: list[Message]) -> None:
        """Take messages of the vehicle's own DVL: they go to the autopilot and to every port."""
        for message in messages:
            data = self._dvl.packed(message)
            if message.get_type() == "VISION_POSITION_DELTA":
                self.endpoints[0].handle(message)
            for waiting in self._waiting:
                waiting.append(data)

    def step(self) -> list[list[bytes]]:
        """The packets that go out now, port by port."""
        vehicle, out = self.vehicle, []
        if vehicle.boots != self._boots:  # what it counts begins anew, and the network is forgotten
            self._boots = vehicle.boots
            self.parsers = [Parser(self._system, COMPONENT) for _ in self.parsers]
            self._heard = [set() for _ in self._heard]
        told = [
            mavlink.MAVLink_statustext_message(text.severity, text.text[:_LONGEST_TEXT].encode())
            for text in vehicle.autopilot.texts
        ]
        vehicle.autopilot.texts.clear()
        told += vehicle.broadcast
        vehicle.broadcast.clear()
        for endpoint, parser, waiting in zip(
            self.endpoints, self.parsers, self._waiting, strict=True
        ):
            endpoint.step()
            messages = [*endpoint.outbox, *told]
            endpoint.outbox.clear()
            out.append([*waiting, *(parser.packed(message) for message in messages)])
            waiting.clear()
        return out
