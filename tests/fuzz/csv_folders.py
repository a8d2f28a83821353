"""Folders of CSV files with their `recording.yaml`."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from motion import smooth_motion

from spinndrift.models.recordings.build import Trajectory
from spinndrift.models.recordings.csv import write_csv
from spinndrift.models.recordings.store import Recording
from spinndrift.models.recordings.summary import summarize
from spinndrift.systems.logs.load import load_data

from .harness import Kind
from .mutate import NUMBERS, WORDS, Rng, bytes_spoiled, encoded, pick, text_spoiled, yaml_spoiled


@cache
def _sound(kind: int) -> tuple[str, str]:
    """Text of a CSV file and of its `recording.yaml`."""
    X, V, _ = smooth_motion(0.05 * np.arange(30), speed=0.5)
    commands = ({"F_Bo_B": np.ones((30, 6))}, {"pwm": np.full((30, 8), 1550.0)})[kind]
    run = Trajectory("surge", X.T, V.T, commands, {"voltage": np.full(30, 15.0)})
    with TemporaryDirectory() as folder:
        write_csv(Recording.from_trajectories([run], 0.05), Path(folder) / "sound")
        table = next((Path(folder) / "sound").glob("*.csv")).read_text()
        meta = (Path(folder) / "sound" / "recording.yaml").read_text()
        return table, meta.replace("check: true", "check: false") if kind else meta


def _spoil(rng: Rng, folder: Path) -> Path:
    table, meta = _sound(pick(rng, (0, 1)))
    target = folder / "run"
    target.mkdir(exist_ok=True)
    for _ in range(int(rng.integers(1, 4))):
        match int(rng.integers(5)):
            case 0 | 1:
                table = _table_spoiled(rng, table)
            case 2:
                table = text_spoiled(rng, table)
            case 3:
                meta = yaml_spoiled(rng, meta)
            case _:
                meta = text_spoiled(rng, meta)
        if len(meta) > 50_000 or len(table) > 200_000 or not _is_yaml(meta):
            break
    raw = encoded(rng, table)
    if rng.random() < 0.1:
        raw = bytes_spoiled(rng, raw)
    (target / "001_surge.csv").write_bytes(raw)
    (target / "recording.yaml").write_bytes(encoded(rng, meta))
    return target


def _is_yaml(text: str) -> bool:
    import yaml

    try:
        yaml.compose(text, yaml.SafeLoader)
    except yaml.YAMLError:
        return False
    return True


def _table_spoiled(rng: Rng, text: str) -> str:
    """Cells, columns and rows of a table."""
    rows = [line.split(",") for line in text.split("\n") if line]
    if not rows or not rows[0]:
        return text
    i, k = int(rng.integers(len(rows))), int(rng.integers(len(rows[0])))
    match int(rng.integers(8)):
        case 0 | 1:
            cell = pick(rng, (*NUMBERS, *WORDS[:4], *WORDS[15:30]))
            some = range(1, len(rows)) if rng.random() < 0.3 else [i]
            for j in some:
                if k < len(rows[j]):
                    rows[j][k] = cell
        case 2:
            for row in rows:
                del row[k : k + 1]
        case 3:
            for row in rows:
                row.insert(k, row[k] if k < len(row) else "")
        case 4:
            names = ("f1", "f8", "f99999999", "pwm1", "pwm0", "pwm³", "X", "voltage", "t", "", "ä")
            rows[0][k] = pick(rng, names)
        case 5:
            rows[1:] = rows[:0:-1]
        case 6:
            scale = pick(rng, (0.0, -1.0, 1e3, 1e12, 1e-12, 1e300))
            for row in rows[1:]:
                try:
                    row[k] = repr(float(row[k]) * scale)
                except (ValueError, IndexError):
                    continue
        case _:
            del rows[i:]
    separator = pick(rng, (",",) * 12 + (";", "\t", "|"))
    return "\n".join(separator.join(row) for row in rows) + "\n"


def _read(path: Path) -> None:
    summarize(load_data(path))
    load_data(path, resample=False)


CSV = Kind("csv", _spoil, _read)
