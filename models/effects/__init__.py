"""Named physical effects that a simulation may lack, each a small module of its own."""

from .base import Effect as Effect
from .base import Parameter as Parameter
from .extended import Extended as Extended
from .library import KINDS as KINDS
from .library import Library as Library
from .library import kind as kind
from .library import register as register
