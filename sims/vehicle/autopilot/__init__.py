"""The autopilot's logic, without sockets, threads or clocks: time is an argument.

It behaves as ArduSub 4.5 does on the wire, with its names, units and traps.
"""
