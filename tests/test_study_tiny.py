"""The tiny study, whole: two methods from their names to the pages that tell of them."""

import pytest

from spinndrift.models.files.checkpoint import load_model
from spinndrift.models.files.owned import MARKER
from spinndrift.models.spinn import Spinn
from spinndrift.sims.cli import main
from spinndrift.sims.study.run import STUDY
from spinndrift.sims.study.table import read_csv

pytestmark = pytest.mark.slow

METHODS = ("fdm-geodesic", "pinn")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny") / "ablation"
    given = ("study", "ablation", "--scale", "tiny", "--seeds", "1", "--regime", "sparse")
    main([*given, "--methods", *METHODS, "--out", str(folder)])
    return folder


def test_every_method_leaves_a_model_and_a_row(out):
    rows = read_csv(out / "table.csv")
    assert {r["method"] for r in rows} == set(METHODS)
    for row in rows:
        assert row["trained"]
        assert row["finite"]
        assert row["steps"] == 8
        assert row["w2"] > 0
        assert row["w2_floor"] == pytest.approx(rows[0]["w2_floor"])  # one truth for all
        folder = out / "sparse" / row["method"] / "seed-0"
        model, _ = load_model(folder / "training" / "model.spinn")
        assert isinstance(model, Spinn)
    silent = next(r for r in rows if r["method"] == "pinn")
    assert silent["b_surge_ratio"] == silent["spread_velocity_ratio"] == 0


def test_the_folder_says_what_is_in_it(out):
    files = {p.name for p in out.iterdir() if p.is_file()}
    assert files <= {*STUDY.files, MARKER}
    marked = {p.parent.relative_to(out).parts for p in out.rglob(MARKER)}
    seeds = {("sparse", method, "seed-0") for method in METHODS}
    assert marked == {(), *seeds, *((*seed, "training") for seed in seeds)}


def test_the_pages_show_it(out):
    report = (out / "report.html").read_text()
    for name in METHODS:
        assert name in report
        assert name in (out / "ablation.md").read_text()
    figures = {"results.png", "training.png", "distributions-surge-forward.png"}
    if any(row["success"] for row in read_csv(out / "table.csv")):  # eight steps may be too few
        figures.add("diffusion.png")
    assert {p.name for p in out.glob("*.png")} == figures
    assert report.count("data:image") == len(figures) + 1  # and the horizon's
