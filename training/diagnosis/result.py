"""What a diagnosis says: the content of `diagnosis.json`, and its schema."""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from ...models.files import atomic_path

Verdict = Literal["adequate", "explained", "partly_explained", "unexplained"]
VERSION = 1


@dataclass(frozen=True)
class Value:
    """An estimate with its 95 % interval."""

    value: float
    unit: str
    interval95: tuple[float, float]


@dataclass(frozen=True)
class Support:
    """Why a cause is believed: a p value for all names together, and nats on data left out."""

    p_value: float
    heldout_gain: float


@dataclass(frozen=True)
class Rival:
    """Another name and what it would have won."""

    name: str
    where: str
    heldout_gain: float


@dataclass(frozen=True)
class Cause:
    """One named cause."""

    name: str
    where: str
    parameters: dict[str, Value]
    evidence: Support
    rivals: list[Rival]
    indistinguishable_from: list[str]
    next_experiment: str


@dataclass(frozen=True)
class AxisResidual:
    """What is left on an axis, against what the noise explains.

    Attributes:
        variance_ratio: innovations' variance over the predicted one; 1 is all explained.
        autocorrelation: at one step; 0 for white.
        mean: in standard errors of a mean of independent numbers.
    """

    variance_ratio: float
    autocorrelation: float
    mean: float


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval by bootstrap over scenarios."""

    value: float
    interval95: tuple[float, float]


@dataclass(frozen=True)
class ModelGain:
    """A model on scenarios left out: nats a sample, and error by horizon (s, as text)."""

    log_score: Interval
    position_rmse: dict[str, Interval]
    rotation_rmse: dict[str, Interval]
    velocity_rmse: dict[str, Interval]


@dataclass(frozen=True)
class DataSummary:
    """What was there, what was missing, what could not be told."""

    scenarios: list[str]
    runs: int
    seconds: float
    step: float
    command: str
    problems: list[str]
    limits: list[str]
    noise: dict[str, float]


@dataclass(frozen=True)
class Diagnosis:
    """The whole finding."""

    version: int
    verdict: Verdict
    sentence: str
    causes: list[Cause]
    residual: dict[str, AxisResidual]
    gain: dict[str, ModelGain]
    data: DataSummary
    tested: int
    threshold: float
    alpha: float
    seconds: float = field(default=0.0)

    def as_json(self) -> str:
        """Text of `diagnosis.json`; numbers that are not finite become null."""
        return json.dumps(_plain(dataclasses.asdict(self)), indent=2, ensure_ascii=False) + "\n"

    def save(self, path: Path) -> None:
        """Write it as JSON; whole or not at all."""
        with atomic_path(path) as partial:
            partial.write_text(self.as_json(), encoding="utf-8")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def schema(cls: Any = Diagnosis) -> dict[str, Any]:
    """JSON Schema (2020-12) of `diagnosis.json`, from the dataclasses themselves."""
    definitions: dict[str, Any] = {}
    body = _schema(cls, definitions)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **body, "$defs": definitions}


def _schema(kind: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        name = kind.__name__
        if name not in definitions:
            definitions[name] = {}
            hints = get_type_hints(kind)
            definitions[name] = {
                "type": "object",
                "description": (kind.__doc__ or "").split("\n")[0],
                "properties": {k: _schema(v, definitions) for k, v in hints.items()},
                "required": [f.name for f in dataclasses.fields(kind)],
                "additionalProperties": False,
            }
        return {"$ref": f"#/$defs/{name}"}
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return {"enum": list(arguments)}
    if origin is list:
        return {"type": "array", "items": _schema(arguments[0], definitions)}
    if origin is tuple:
        size = len(arguments)
        items = _schema(arguments[0], definitions)
        return {"type": "array", "items": items, "minItems": size, "maxItems": size}
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(arguments[1], definitions)}
    if origin in (Union, UnionType):
        return {"anyOf": [_schema(a, definitions) for a in arguments]}
    plain = {float: ["number", "null"], int: "integer", str: "string", bool: "boolean"}
    return {"type": plain[kind]}
