"""All kinds of inputs, by name."""

from .bags import BAG
from .checkpoints import CHECKPOINT
from .csv_folders import CSV
from .logs import BIN, TLOG
from .mavlink_frames import MAVLINK
from .netcdf import NETCDF
from .yaml_files import YAML

KINDS = {kind.name: kind for kind in (TLOG, BIN, BAG, NETCDF, CSV, YAML, CHECKPOINT, MAVLINK)}
