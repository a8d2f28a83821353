"""The judgements of many cases as tables: confusion, detection, false alarms, gain, parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from rich.console import Console
from rich.table import Table as Grid

from .cases import USUAL
from .judging import CLOSE

Row = dict[str, Any]
ENOUGH = 0.9
"""Share of the true model's gain that an extended model should reach."""


@dataclass(frozen=True)
class Table:
    """A table with its caption."""

    caption: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]

    def markdown(self) -> str:
        """As Markdown."""
        lines = [
            f"| {' | '.join(self.header)} |",
            f"|{'---|' * len(self.header)}",
            *(f"| {' | '.join(row)} |" for row in self.rows),
        ]
        return f"{self.caption}\n\n" + "\n".join(lines) + "\n"


def print_tables(shown: Console, tables: Sequence[Table]) -> None:
    """Print tables on a terminal."""
    for table in tables:
        grid = Grid(*table.header, title=table.caption, title_justify="left")
        for row in table.rows:
            grid.add_row(*row)
        shown.print(grid)


def interval(hits: int, total: int, level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of a share (Clopper and Pearson 1934), exact by the beta distribution."""
    tail = (1 - level) / 2
    low = 0.0 if hits == 0 else float(scipy.stats.beta.ppf(tail, hits, total - hits + 1))
    high = 1.0 if hits == total else float(scipy.stats.beta.ppf(1 - tail, hits + 1, total - hits))
    return low, high


def share(hits: int, total: int) -> str:
    """`9 of 10 (0.55 to 1.00)`."""
    if total == 0:
        return "–"
    low, high = interval(hits, total)
    return f"{hits} of {total} ({low:.2f} to {high:.2f})"


def tables(rows: Sequence[Row]) -> list[Table]:
    """All tables for which there are cases."""
    usual = [r for r in rows if r["data"] == USUAL]
    found = [_summary(usual), _confusion(usual), _sizes(usual), _parts(usual), _mixed(usual)]
    found += [_faults(usual), _verdicts(rows), _varied(rows), _wrong(rows), _misses(rows)]
    found.append(_rivals(usual))
    return [table for table in found if table.rows]


def _of(rows: Sequence[Row], *kinds: str) -> list[Row]:
    return [r for r in rows if r["kind"] in kinds]


def _middle(values: Sequence[float], digits: int = 2) -> str:
    return f"{np.median(values):.{digits}f}" if len(values) else "–"


def gain_share(row: Row) -> float | None:
    """The share of the gain over all parts of the state; None if it was not judged."""
    return row["gain"].get("all")


def _summary(rows: Sequence[Row]) -> Table:
    nulls, singles = _of(rows, "null"), _of(rows, "single")
    true = [r for r in singles if r["size"] == 1]
    lines = []
    if nulls:
        lines.append(("false alarms", share(sum(bool(r["named"]) for r in nulls), len(nulls))))
    if true:
        lines.append(
            (
                "single causes of realistic size: first cause right",
                share(sum(r["first_right"] for r in true), len(true)),
            )
        )
        lines.append(
            (
                "hidden cause first, or reported as indistinguishable from the first",
                share(sum(r["declared"] for r in true), len(true)),
            )
        )
        alone = sum(r["first_right"] and len(r["named"]) == 1 for r in true)
        lines.append(("first cause right and no other cause reported", share(alone, len(true))))
        placed = [r["place_right"] for r in true if r["place_right"] is not None]
        lines.append(("place of the first cause right", share(sum(placed), len(placed))))
    z = np.abs([z for r in rows for z in r["z"].values() if z == z])
    if len(z):
        near = share(int(sum(z <= CLOSE)), len(z))
        lines.append((f"parameters within {CLOSE:g} standard errors", near))
        lines.append(("median deviation of parameters, in standard errors", _middle(list(z))))
        off = [abs(x - 1) for r in rows for x in r["ratio"].values()]
        lines.append(
            ("median relative deviation of parameters", f"{100 * float(np.median(off)):.1f} %")
        )
    gains = [g for r in singles if (g := gain_share(r)) is not None]
    if gains:
        good = sum(g >= ENOUGH for g in gains)
        lines.append(
            ("single causes with at least 90 % of the true model's gain", share(good, len(gains)))
        )
        lines.append(("median share of the true model's gain", _middle(gains, 3)))
    unknown = _of(rows, "unknown")
    if unknown:
        hits = sum(r["first_right"] for r in unknown)
        what = "unmodelled structure reported as `unknown` with a right variable"
        lines.append((what, share(hits, len(unknown))))
    if singles:
        wrong = sum("unknown" in r["named"] for r in singles)
        lines.append(("named effects reported as `unknown`", share(wrong, len(singles))))
    seconds = [r["seconds"] for r in rows]
    if seconds:
        lines.append(
            (
                "computing time of a diagnosis, median and maximum",
                f"{np.median(seconds):.0f} s, {max(seconds):.0f} s",
            )
        )
    return Table("Shares with 95 % intervals (Clopper and Pearson).", ("", ""), lines)


def _confusion(rows: Sequence[Row]) -> Table:
    chosen = [r for r in _of(rows, "single", "unknown") if r["size"] == 1]
    lines = []
    for label in dict.fromkeys(r["label"] for r in chosen):
        own = [r for r in chosen if r["label"] == label]
        others: dict[str, int] = {}
        for r in own:
            named = ", ".join(dict.fromkeys(r["named"])) or "adequate"
            others[named] = others.get(named, 0) + 1
        listed = "; ".join(f"{k} × {n}" if len(own) > 1 else k for k, n in others.items())
        z = [abs(v) for r in own for v in r["z"].values()]
        gains = [g for r in own if (g := gain_share(r)) is not None]
        hits = sum(r["first_right"] for r in own)
        lines.append(
            (
                label,
                f"{hits} of {len(own)}",
                listed,
                f"{max(z):.1f}" if z else "–",
                _middle(gains),
                f"{np.median([r['seconds'] for r in own]):.0f}",
            )
        )
    header = ("hidden", "first cause right", "reported, in order", "largest z", "gain", "s")
    caption = (
        "Single causes of realistic size: reported causes, largest deviation z of a parameter in "
        "standard errors, share of the true model's gain, computing time."
    )
    return Table(caption, header, lines)


def _sizes(rows: Sequence[Row]) -> Table:
    chosen = _of(rows, "single", "unknown")
    sizes = sorted({r["size"] for r in chosen})
    if len(sizes) < 2:
        return Table("", (), [])
    lines = []
    for size in sizes:
        own = [r for r in chosen if r["size"] == size]
        seen = sum(bool(r["named"]) for r in own)
        right = sum(r["first_right"] for r in own)
        lines.append((f"{size:g}", share(seen, len(own)), share(right, len(own))))
    return Table(
        "Detection against the size of the effect (1 is realistic).",
        ("size", "any cause reported", "first cause right"),
        lines,
    )


def _verdicts(rows: Sequence[Row]) -> Table:
    """What is claimed, by kind of recording."""
    chosen = _of(rows, "null", "single", "part", "pair", "triple", "unknown", "wrong")
    lines = []
    for kind in _kinds(chosen):
        own = [r for r in chosen if r["data"] == kind]
        right = [r for r in own if not r["hidden"] and r["kind"] != "wrong"]
        off = [r for r in own if r not in right]
        lines.append(
            (
                kind,
                share(sum(r["verdict"] == "adequate" for r in right), len(right)),
                share(sum(r["verdict"] != "adequate" for r in off), len(off)),
                share(sum(r["verdict_right"] for r in own), len(own)),
            )
        )
    header = ("data", "adequate when it is", "not adequate when it is not", "verdict right")
    return Table("Verdicts, by kind of recording.", header, lines)


def _kinds(rows: Sequence[Row]) -> list[str]:
    """Kinds of recording, the usual one first."""
    return sorted(dict.fromkeys(r["data"] for r in rows), key=lambda k: (k != USUAL, k))


def _wrong(rows: Sequence[Row]) -> Table:
    """Beliefs that are off by factors, with and without a hidden cause."""
    lines = []
    for r in _of(rows, "wrong"):
        off = list(r["coefficients"].values())
        near = share(sum(abs(z) <= CLOSE for z, _ in off), len(off))
        deviation = f"{100 * np.median([abs(x - 1) for _, x in off]):.1f} %" if off else "–"
        hidden = ", ".join(r["hidden"]) or "–"
        named = ", ".join(r["named"]) or "–"
        lines.append((r["data"], hidden, r["verdict"], named, near, deviation))
    header = (
        "data", "hidden", "verdict", "reported causes", f"coefficients within {CLOSE:g} SE",
        "median deviation",
    )  # fmt: skip
    caption = "Beliefs that are wrong by factors in nearly every coefficient, by case."
    return Table(caption, header, lines)


def _varied(rows: Sequence[Row]) -> Table:
    """Single causes of realistic size, by kind of recording."""
    chosen = [r for r in _of(rows, "single") if r["size"] == 1]
    kinds = _kinds(chosen)
    if kinds in ([], [USUAL]):
        return Table("", (), [])
    lines = []
    for kind in kinds:
        own = [r for r in chosen if r["data"] == kind]
        z = np.abs([z for r in own for z in r["z"].values() if z == z])
        gains = [g for r in own if (g := gain_share(r)) is not None]
        lines.append(
            (
                kind,
                share(sum(r["first_right"] for r in own), len(own)),
                str(sum(r["declared"] for r in own)),
                str(sum(r["first_right"] and len(r["named"]) == 1 for r in own)),
                str(sum(not r["named"] for r in own)),
                share(int(np.sum(z <= CLOSE)), len(z)),
                share(sum(g >= ENOUGH for g in gains), len(gains)),
                f"{np.median([r['seconds'] for r in own]):.0f}",
            )
        )
    header = (
        "data", "first cause right", "or indistinguishable", "no other cause", "no cause",
        f"parameters within {CLOSE:g} SE", "gain ≥ 90 %", "s",
    )  # fmt: skip
    return Table("Single causes of realistic size, by kind of recording.", header, lines)


def _misses(rows: Sequence[Row]) -> Table:
    """Reported causes of cases with other data than usual whose first cause is wrong."""
    wrong = [r for r in _of(rows, "single") if r["data"] != USUAL and not r["first_right"]]
    lines = [(r["data"], r["label"], ", ".join(r["named"]) or "adequate") for r in wrong]
    caption = "Cases with other data than usual whose first cause is wrong."
    return Table(caption, ("data", "hidden", "reported, in order"), lines)


def _rivals(rows: Sequence[Row]) -> Table:
    """Gains of other methods on the same files, with the number of terms of sparse ones."""
    chosen = [r for r in rows if r.get("rivals") and r["size"] == 1]
    chosen.sort(key=lambda r: (r["kind"] == "null", r["kind"] != "single", r["label"]))
    lines = []
    for label in dict.fromkeys(r["label"] for r in chosen):
        own = [r for r in chosen if r["label"] == label]
        if not any(r["gain"] or r["kind"] == "null" for r in own):
            continue
        gains = [g for r in own if (g := gain_share(r)) is not None]
        cells = [_middle(gains)]
        for name in own[0]["rivals"]:
            others = [r["rivals"][name] for r in own if name in r["rivals"]]
            cell = _middle([o["gain"]["all"] for o in others if o["gain"]])
            counts = [o["count"] for o in others if o["count"] is not None]
            cells.append(f"{cell} ({np.median(counts):.0f})" if counts else cell)
        named = ", ".join(dict.fromkeys(n for r in own for n in r["named"])) or "adequate"
        lines.append((label, named, *cells))
    names = tuple(chosen[0]["rivals"]) if chosen else ()
    caption = (
        "Rival methods on the same files: share of the true model's gain, median over cases. In "
        "brackets: number of terms of a sparse regression over all six axes, without constants."
    )
    return Table(caption, ("hidden", "reported by spinndrift", "its gain", *names), lines)


def _parts(rows: Sequence[Row]) -> Table:
    """Causes that act in a part of the data."""
    chosen, lines = _of(rows, "part"), []
    for label in dict.fromkeys(r["label"] for r in chosen):
        own = [r for r in chosen if r["label"] == label]
        z = [abs(v) for r in own for v in r["z"].values()]
        lines.append(
            (
                label,
                f"{sum(r['first_right'] for r in own)} of {len(own)}",
                f"{sum(r['first_right'] and r['when_right'] for r in own)}",
                "; ".join(dict.fromkeys(", ".join(r["named"]) or "adequate" for r in own)),
                f"{max(z):.1f}" if z else "–",
                f"{np.median([r['seconds'] for r in own]):.0f}",
            )
        )
    header = ("hidden", "first cause right", "part right too", "reported", "largest z", "s")
    caption = (
        "Causes that act in a part of the session: begin and end are right within 0.5 s, in the "
        "right run."
    )
    return Table(caption, header, lines)


def _mixed(rows: Sequence[Row]) -> Table:
    lines = []
    for name in ("pair", "triple"):
        own = _of(rows, name)
        if own:
            hidden = sum(len(r["hidden"]) for r in own)
            lines.append(
                (
                    f"{name}s",
                    share(sum(r["first_right"] for r in own), len(own)),
                    share(sum(r["recalled"] for r in own), hidden),
                    f"{sum(r['spurious'] for r in own) / len(own):.2f}",
                )
            )
    header = ("", "first cause right", "causes found", "wrong causes per case")
    return Table("Several hidden causes.", header, lines)


def _faults(rows: Sequence[Row]) -> Table:
    lines = [
        (
            r["label"],
            "yes" if r["told"] else "no",
            ", ".join(r["named"]) or "adequate",
        )
        for r in _of(rows, "fault")
    ]
    return Table("Faulty data.", ("fault", "reported", "causes"), lines)
