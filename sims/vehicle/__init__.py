"""A simulated vehicle behind a MAVLink server that behaves as ArduSub does."""
