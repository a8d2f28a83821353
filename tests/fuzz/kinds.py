"""All kinds of files, by name."""

from .checkpoints import CHECKPOINT
from .csv_folders import CSV
from .logs import BIN, TLOG
from .netcdf import NETCDF
from .yaml_files import YAML

KINDS = {kind.name: kind for kind in (TLOG, BIN, NETCDF, CSV, YAML, CHECKPOINT)}
