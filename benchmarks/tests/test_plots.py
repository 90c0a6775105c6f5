"""Charts: what they hold, and their drawing: well-formed SVG of equal bytes, points where the axes say, every name in
the legend and nothing outside."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from splatbench.report import plots
from splatbench.report.plots import HorizontalLine, Plot, Point, Series, draw
from splatbench.report.summary import MethodNames, summarize

from benchmarks.tests.support.runs import COLUMNS, METHODS, FakeTable, record

SVG = "{http://www.w3.org/2000/svg}"


def crowd(count: int, joined: bool) -> Plot:
    """Methods as near to each other as they come."""
    rng = np.random.default_rng(3)
    series = []
    for k in range(count):
        points = [Point(x, y, y - 0.5, y + 0.5, "10") for x, y in zip((1, 2, 4), 20 + rng.random(3), strict=True)]
        label = f"Method & <{k}> with a name that needs two lines"
        series.append(Series(label, k, tuple(points if joined else points[:1]), joined, k == 2))
    return Plot("A & B", "x", "y", tuple(series), (HorizontalLine("Nothing", 19.9),), log_x=not joined)


def texts(root: ET.Element) -> list[str]:
    return [text for element in root.iter(f"{SVG}text") if (text := "".join(element.itertext()))]


@pytest.mark.parametrize("width", [372, 720])
@pytest.mark.parametrize("joined", [False, True])
def test_svg_is_well_formed_and_names_everything(width, joined):
    chart = crowd(12, joined)
    root = ET.fromstring(draw(chart, width))
    assert root.get("width") == str(width) and root.get("viewBox", "").startswith(f"0 0 {width} ")
    assert next(root.iter(f"{SVG}title")).text == "A & B"
    lines = " ".join(texts(root))
    assert all(series.label in lines for series in chart.series) and "Nothing" in lines
    height = float(root.get("height", ""))
    for element in root.iter(f"{SVG}text"):
        if position := re.search(r"translate\(([-\d.]+) ([-\d.]+)\)", element.get("transform", "")):
            x, y = map(float, position.groups())
        else:
            x, y = float(element.get("x", "0")), float(element.get("y", "0"))
        assert 0 <= x <= width and 0 <= y <= height


def test_legend_names_methods_from_the_best_down():
    chart = crowd(12, False)
    values = {s.label: s.points[0].y for s in chart.series} | {"Nothing": 19.9}
    lines = " ".join(texts(ET.fromstring(draw(chart, 720))))
    order = sorted(values, key=lambda label: lines.index(label))
    assert order == sorted(values, key=lambda label: -values[label])


def test_equal_charts_are_equal_bytes_without_a_date():
    first = draw(crowd(3, True), 720)
    assert first == draw(crowd(3, True), 720) and "date" not in first.lower() and "matplotlib.org" not in first


def test_colours_know_both_grounds():
    text = draw(crowd(3, True), 720)
    assert "prefers-color-scheme:dark" in text and "var(--c0, #0064a8)" in text and "var(--ground, #fbfaf8)" in text
    bare = re.sub(r"var\(--\w+, #\w+\)|--\w+:#\w+;", "", text)
    assert not re.findall(r"#[0-9a-f]{6}\b", bare), "every colour is a variable"


def test_a_level_far_off_is_named_with_its_value_and_does_not_squeeze_the_points():
    series = tuple(Series(f"s{k}", k, (Point(1 + k, 30 + 5 * k),)) for k in range(3))
    levels = (HorizontalLine("Untouched", 100.0), HorizontalLine("Near", 28.0))
    names = texts(ET.fromstring(draw(Plot("t", "x", "y", series, levels), 720)))
    assert "Untouched: 100 ↑" in names and "Near" in names
    assert max(float(name) for name in names if name.isdigit()) == 40


def test_points_are_where_the_axes_say():
    chart = Plot("t", "x", "y", (Series("a", 0, (Point(1, 2), Point(100, 4)), True),), log_x=True)
    root = ET.fromstring(draw(chart, 720))
    [line] = [
        g for g in root.iter(f"{SVG}g") if g.get("id", "").startswith("line2d") and len(list(g.iter(f"{SVG}use"))) == 2
    ]
    path = next(line.iter(f"{SVG}path")).get("d", "")
    (x1, y1), (x2, y2) = [tuple(map(float, pair)) for pair in re.findall(r"([\d.]+) ([\d.]+)", path)]
    ticks = {}
    for group in root.iter(f"{SVG}g"):
        if group.get("id", "").startswith(("xtick", "ytick")):
            mark = next(group.iter(f"{SVG}use"), None)
            if mark is not None:
                ticks["".join(next(group.iter(f"{SVG}text")).itertext())] = float(mark.get("x", ""))
    assert (x1, x2) == pytest.approx((ticks["1"], ticks["100"])) and y1 > y2


def test_all_styles_differ():
    assert len({(k % len(plots.COLORS), k % len(plots.MARKERS)) for k in range(35)}) == 35


def test_a_chart_of_nothing_is_an_error():
    with pytest.raises(ValueError, match="chart 'Empty': expected at least one point"):
        draw(Plot("Empty", "x", "y", (Series("a", 0, (Point(1, math.nan),)),)), 720)
    with pytest.raises(ValueError, match="chart 'Empty': expected at least one point"):
        draw(Plot("Empty", "x", "y", (Series("a", 0, (Point(0, 1),)),), log_x=True), 720)


def test_quality_against_seconds_has_points_curves_and_levels():
    def curve(gain: float) -> list[dict[str, float | None]]:
        return [{"seconds": s * gain, "steps": s, "psnr": 10.0 + gain} for s in (10, 30, 100)]

    records = [record("nothing", n, 15, edit_seconds=0.0) for n in "ab"] + [record("ttt", n, 20) for n in "ab"]
    records += [record("3dgs", "a", 18, edit_seconds=300.0, curve=curve(1.0))]
    records += [record("3dgs", "b", 22, edit_seconds=500.0, curve=curve(2.0)[:2])]
    names = MethodNames.of(METHODS, {r.method for r in records})
    chart = plots.against_seconds(summarize(records), records, COLUMNS[0], names)
    assert chart is not None and chart.log_x
    assert [(level.label, level.y) for level in chart.levels] == [("Asset as it is", 15)]
    by_name = {s.label: s for s in chart.series}
    assert [(p.x, p.y) for p in by_name["Ours (TTT)"].points] == [(1, 20)] and not by_name["Ours (TTT)"].joined
    # steps that both cases have: 10 and 30; medians of seconds (10, 20) and (30, 60), means of figures (11, 12)
    assert [(p.x, p.y) for p in by_name["3DGS"].points] == [(15, 11.5), (45, 11.5), (400, 20)]


def test_quality_against_views_is_in_order_and_apart():
    records = [record("ttt", f"{n}-{v}", 20 + v, facts={"views": v}) for n in "ab" for v in (4, 1, 2)]
    records += [record("3dgs", f"{n}-{v}", 10 + v, facts={"views": v}) for n in "ab" for v in (4, 1, 2)]
    drawn = plots.charts(records, FakeTable(split_by="views"), MethodNames.of(METHODS, {"ttt", "3dgs"}))
    assert [chart.title for chart in drawn] == [
        "PSNR against seconds (views 4)",
        "PSNR against number of views",
    ]
    lines = drawn[1].series
    assert [[p.y for p in s.points] for s in lines] == [[21, 22, 24], [11, 12, 14]]
    assert [value for value, _ in drawn[1].x_ticks] == [1, 2, 4]
    assert all(abs(p.x - v) < 0.25 for s in lines for p, v in zip(s.points, (1, 2, 4), strict=True))


def test_steps_in_a_row_and_gaussians_at_each_stage():
    stages = {"gaussians_before": 1000.0, "gaussians_kept": 250.0}
    records = [record(method, n, 20, numbers=stages) for method in ("ttt", "3dgs") for n in "ab"]
    for k, r in enumerate(records):
        r.figures.update({f"psnr_{step}": 30.0 - step + k % 2 for step in (1, 2, 10)}, ssim_1=0.5)
    drawn = {c.title: c for c in plots.charts(records, FakeTable(), MethodNames.of(METHODS, {"ttt", "3dgs"}))}
    assert set(drawn) == {"PSNR against seconds", "PSNR after each step", "Gaussians at each stage"}
    first = drawn["PSNR after each step"].series[0].points
    assert [(round(p.x), p.y) for p in first] == [(1, 29.5), (2, 28.5), (10, 20.5)]
    assert plots.charts(records[:2], FakeTable(), MethodNames.of(METHODS, {"ttt"})) == [], "one method is no comparison"
    assert [p.y for p in drawn["Gaussians at each stage"].series[0].points] == [1000, 250, 100]
