"""Draws the closed loop's block diagram: `python -m spinndrift.sims.run.diagram FILE.svg`.

Layout is Graphviz's (`dot` must be installed); blocks and ports are those of the built diagram.
"""

import subprocess
import sys
from pathlib import Path

import jax
from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, System

from ...models.config.errors import UserError
from ...models.files.atomic import atomic_path
from ...systems.closed_loop import build_diagram
from ..scenarios.scenario import load_scenario


def draw(scenario: str = "pylon_crossing_harbour") -> str:
    """Graphviz text of a scenario's diagram: station and controller with their subsystems."""
    chosen = load_scenario(scenario)
    diagram = build_diagram(chosen.station, chosen.controller, log_periods={})
    out = [
        "digraph closed_loop {",
        'rankdir=LR; nodesep=0.35; ranksep=0.55; fontname="Helvetica"; compound=true;',
        'node [shape=box style="rounded,filled" fillcolor="#eef4f7" color="#14607a" '
        'fontname="Helvetica" fontsize=12 margin="0.16,0.09"];',
        'edge [color="#5b6b7a" fontname="Helvetica" fontsize=9 fontcolor="#5b6b7a" arrowsize=0.7];',
    ]
    edges: dict[tuple[str, str], list[str]] = {}
    for system in diagram.GetSystems():
        if not isinstance(system, Diagram):
            continue
        out.append(f'subgraph cluster_{system.get_name()} {{ label="{system.get_name()}"; '
                   'style="rounded"; color="#c4ced6"; fontsize=14;')  # fmt: skip
        for part in _parts(system):
            out.append(f'"{_node(part)}" [label="{part.get_name()}"];')
        out.append("}")
        _inner_edges(system, edges)
    _outer_edges(diagram, edges)
    for (source, target), names in edges.items():
        label = "\\n".join(dict.fromkeys(names))
        out.append(f'"{source}" -> "{target}" [label="{label}"];')
    out.append("}")
    return "\n".join(out)


def _parts(diagram: Diagram) -> list[System]:
    return [s for s in diagram.GetSystems() if type(s).__name__ != "RandomSource"]


def _node(system: System) -> str:
    return system.GetSystemPathname()


def _inner_edges(diagram: Diagram, edges: dict[tuple[str, str], list[str]]) -> None:
    connections = diagram.connection_map()
    shown = {_node(s) for s in _parts(diagram)}
    for (target, _), (source, port) in connections.items():
        pair = (_node(source), _node(target))
        if pair[0] in shown and pair[1] in shown:
            name = source.get_output_port(port).get_name()
            edges.setdefault(pair, []).append(name)


def _outer_edges(diagram: Diagram, edges: dict[tuple[str, str], list[str]]) -> None:
    """Connections between subdiagrams, drawn between the blocks inside them."""
    for (target, index), (source, port) in diagram.connection_map().items():
        out_port = source.get_output_port(port)
        for from_node in _exporters(source, out_port.get_name()):
            for to_node in _importers(target, target.get_input_port(index).get_name()):
                edges.setdefault((from_node, to_node), []).append(out_port.get_name())


def _exporters(system: System, name: str) -> list[str]:
    if not isinstance(system, Diagram):
        return []
    for index in range(system.num_output_ports()):
        if system.get_output_port(index).get_name() == name:
            inner, _ = system.get_output_port_locator(OutputPortIndex(index))
            return [_node(inner)]
    return []


def _importers(system: System, name: str) -> list[str]:
    if not isinstance(system, Diagram):
        return []
    for index in range(system.num_input_ports()):
        if system.get_input_port(index).get_name() == name:
            return [_node(inner) for inner, _ in system.GetInputPortLocators(InputPortIndex(index))]
    return []


def main(arguments: list[str] | None = None) -> None:
    """Write the drawing to the named file (.svg, .pdf or .png)."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) != 1:
        raise UserError("usage: python -m spinndrift.sims.run.diagram FILE.svg")
    jax.config.update("jax_enable_x64", True)
    path = Path(given[0])
    with atomic_path(path) as partial:
        subprocess.run(
            ["dot", f"-T{path.suffix.removeprefix('.')}", "-o", str(partial)],
            input=draw(), text=True, check=True,
        )  # fmt: skip


if __name__ == "__main__":
    main()
