"""Disturbances of the vehicle: body wrenches, moving water, the tether."""

from .base import Disturbance as Disturbance
from .combined import Combined as Combined
from .combined import Kind as Kind
from .combined import preset as preset
from .combined import preset_names as preset_names
from .current import GaussMarkovCurrent as GaussMarkovCurrent
from .linear_waves import orbital_factors as orbital_factors
from .linear_waves import wave_number as wave_number
from .ornstein_uhlenbeck import OrnsteinUhlenbeckWrench as OrnsteinUhlenbeckWrench
from .surface import Surface as Surface
from .tether import Tether as Tether
from .wake import ShipWake as ShipWake
from .waves import JonswapWaves as JonswapWaves
from .waves import jonswap as jonswap
from .white import WhiteWrench as WhiteWrench
