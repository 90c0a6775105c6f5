"""Charts: ticks by hand, label places against another solver, no two labels on each other, well-formed SVG."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import isotonic_regression
from splatbench.report import plots, svg
from splatbench.report.labels import overlap, place, shortened, spread, text_width, wrapped
from splatbench.report.names import Names
from splatbench.report.scales import Scale, fitted, linear_ticks, log_ticks, tick_text
from splatbench.report.summary import summarize

from benchmarks.tests.support.runs import COLUMNS, METHODS, FakeTable, record


@pytest.mark.parametrize(
    ("low", "high", "most", "wanted"),
    [
        (0, 10, 6, [0, 2, 4, 6, 8, 10]),
        (0, 1, 6, [0, 0.2, 0.4, 0.6, 0.8, 1]),
        (17.2, 25.9, 6, [18, 20, 22, 24]),
        (-3, 3, 7, [-3, -2, -1, 0, 1, 2, 3]),
        (0.811, 0.836, 6, [0.815, 0.82, 0.825, 0.83, 0.835]),
        (1e5, 1.3e5, 4, [100000, 110000, 120000, 130000]),
    ],
)
def test_linear_ticks_are_round_values(low, high, most, wanted):
    assert linear_ticks(low, high, most) == wanted  # as floats nearest to the decimals: no 0.6000000000000001


@pytest.mark.parametrize(
    ("low", "high", "most", "wanted"),
    [
        (0.9, 11, 7, [1, 2, 5, 10]),
        (0.01, 100, 7, [0.01, 0.1, 1, 10, 100]),
        (0.05, 300, 8, [0.1, 0.3, 1, 3, 10, 30, 100, 300]),
        (1e-4, 1e4, 5, [1e-4, 1e-2, 1, 1e2, 1e4]),
        (3.1, 4.4, 7, [3.2, 3.4, 3.6, 3.8, 4, 4.2, 4.4]),
    ],
)
def test_log_ticks_are_powers_of_ten_and_what_stands_between(low, high, most, wanted):
    assert log_ticks(low, high, most) == wanted


def test_tick_text_is_short():
    told = [tick_text(v) for v in (0, 0.1, 1000, -2.5, 1e-5, 3e8, 0.0003)]
    assert told == ["0", "0.1", "1,000", "−2.5", "1e-5", "3e8", "0.0003"]


def test_scales_map_ends_to_ends_and_ratios_to_distances():
    linear, log = Scale(10, 20, 100, 0), Scale(0.1, 1000, 0, 400, log=True)
    assert [linear(v) for v in (10, 15, 20)] == [100, 50, 0]
    assert [log(v) for v in (0.1, 1, 10, 1000)] == pytest.approx([0, 100, 200, 400])


def test_fitted_scales_leave_room_and_never_collapse():
    scale = fitted([1, 3, math.inf, math.nan], 0, 112)
    assert (scale(1), scale(3)) == pytest.approx((6, 106))
    assert fitted([5, 5], 0, 100)(5) == pytest.approx(50)
    assert fitted([0, -1, 2], 0, 100, log=True)(2) == pytest.approx(50)
    with pytest.raises(ValueError, match="at least one finite value above 0"):
        fitted([0, -1], 0, 1, log=True)


def test_spread_by_hand():
    assert spread([10, 11], 10, 0, 100) == [5.5, 15.5]  # both give way by as much
    assert spread([1, 2], 10, 0, 100) == [0, 10]  # up to the edge, not beyond
    assert spread([50, 10, 90], 10, 0, 100) == [50, 10, 90]  # nothing to do
    with pytest.raises(ValueError, match="3 of 10 pixels do not fit into 19"):
        spread([1, 2, 3], 10, 0, 19)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0, 200), min_size=1, max_size=12))
def test_spread_is_the_nearest_arrangement(wanted):
    places = spread(wanted, 12, -1000, 1000)
    order = np.argsort(wanted, kind="stable")
    ranks = 12 * np.arange(len(wanted))
    oracle = isotonic_regression(np.array(wanted)[order] - ranks).x + ranks
    assert np.array(places)[order] == pytest.approx(oracle)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(20, 380), st.floats(20, 280)), min_size=1, max_size=14), st.integers(20, 120))
def test_labels_stay_inside_and_off_each_other(anchors, width):
    frame = (0.0, 0.0, 400.0, 300.0)
    marks = [(x - 6, y - 6, x + 6, y + 6) for x, y in anchors]
    boxes = [b for b in place([[a] for a in anchors], [(width, 13.0)] * len(anchors), frame, marks) if b]
    assert boxes, "the first label always finds a place"
    assert all(0 <= b[0] and 0 <= b[1] and b[2] <= 400 and b[3] <= 300 for b in boxes)
    assert not any(overlap(a, b) for a, b in combinations(boxes, 2))


def test_a_lone_label_stands_right_of_its_point_and_left_at_the_edge():
    assert place([[(50, 50)]], [(40, 10)], (0, 0, 200, 100), clear=8) == [(58, 45, 98, 55)]
    assert place([[(190, 50)]], [(40, 10)], (0, 0, 200, 100), clear=8) == [(142, 45, 182, 55)]
    assert place([[(5, 5)]], [(400, 10)], (0, 0, 200, 100)) == [None]


def test_labels_keep_off_lines():
    """A level across the frame, a slanted curve, whiskers: there is room beside them."""
    frame = (0.0, 0.0, 400.0, 300.0)
    lines = [((0.0, 150.0), (400.0, 150.0)), ((20.0, 280.0), (380.0, 40.0)), ((200.0, 20.0), (200.0, 290.0))]
    anchors = [[(float(x), 150.0) for x in range(380, 20, -40)], [(200.0, 160.0)], [(380.0, 40.0), (20.0, 280.0)]]
    boxes = place(anchors, [(60, 13), (60, 13), (60, 13)], frame, [(194, 154, 206, 166)], lines)
    for box in boxes:
        assert box is not None
        for (ax, ay), (bx, by) in lines:  # many points of the line, none in the box
            t = np.linspace(0, 1, 2001)
            x, y = ax + t * (bx - ax), ay + t * (by - ay)
            assert not ((x > box[0]) & (x < box[2]) & (y > box[1]) & (y < box[3])).any()


def test_text_is_wrapped_to_lines_that_fit():
    lines = wrapped("Edit-and-fit from true views, all attributes, finer rows", 12, 200)
    assert " ".join(lines) == "Edit-and-fit from true views, all attributes, finer rows" and len(lines) == 2
    short = wrapped("one two three four five six seven eight", 12, 60)
    assert len(short) == 2 and short[1].endswith("…") and all(text_width(line, 12) <= 60 for line in short)
    assert wrapped("", 12, 60) == [""]


def test_text_is_shortened_to_what_fits():
    assert shortened("abc", 12, 100) == "abc"
    short = shortened("a very long name of a method", 12, 80)
    assert short.endswith("…") and text_width(short, 12) <= 80 < text_width("a very long name of a", 12)


def crowd(count: int, at_ends: bool) -> svg.Chart:
    """Methods as near to each other as they come."""
    rng = np.random.default_rng(3)
    series = []
    for k in range(count):
        points = zip((1, 2, 4), 20 + rng.random(3), strict=True)
        marks = [svg.Mark(x, y, y - 0.5, y + 0.5, "tip <b>", "10") for x, y in points]
        series.append(svg.Series(f"Method & <{k}>", k, tuple(marks if at_ends else marks[:1]), at_ends, key=f"m{k}"))
    level = svg.Level("Nothing", 19.9, key="nothing")
    return svg.Chart("A & B", svg.Axis("x", not at_ends), svg.Axis("y"), tuple(series), (level,), at_ends)


@pytest.mark.parametrize("width", [372, 720])
@pytest.mark.parametrize("at_ends", [False, True])
def test_svg_is_well_formed_and_its_labels_do_not_collide(width, at_ends):
    root = ET.fromstring(svg.draw(crowd(12, at_ends), width))
    labels = [t for t in root.iter("text") if t.get("class") == "label"]
    boxes = []
    for t in labels:
        x, y, said = float(t.get("x", "")), float(t.get("y", "")), "".join(t.itertext())
        boxes.append((x, y - 9, x + text_width(said, 12) / 1.08, y + 2))
    assert len(labels) >= 11 and not any(overlap(a, b) for a, b in combinations(boxes, 2))
    view = [float(v) for v in root.get("viewBox", "").split()]
    assert view[2] == width and all(b[0] >= 0 and b[2] <= width and b[1] >= 0 and b[3] <= view[3] for b in boxes)
    assert root.get("aria-label") == "A & B" and len([n for n in root.iter("title")]) >= 12


def test_many_methods_are_named_in_a_legend_from_the_best_down():
    chart = crowd(12, False)
    for width in (720, 372):
        root = ET.fromstring(svg.draw(chart, width))
        named = [t for t in root.iter("text") if t.get("class") == "label"]
        assert len({t.get("x") for t in named}) == 1, "one column"
        said = [t.text for t in sorted(named, key=lambda t: float(t.get("y", "")))]
        height = {s.label: s.marks[0].y for s in chart.series} | {"Nothing": 19.9}
        assert said == sorted(height, key=lambda name: -height[name])
    few = ET.fromstring(svg.draw(crowd(3, False), 720))
    assert len({t.get("x") for t in few.iter("text") if t.get("class") == "label"}) > 1


def test_a_level_far_off_is_said_and_does_not_squeeze_the_points():
    marks = [svg.Series(f"s{k}", k, (svg.Mark(1 + k, 30 + 5 * k),)) for k in range(3)]
    levels = (svg.Level("Untouched", 100.0), svg.Level("Near", 28.0))
    root = ET.fromstring(svg.draw(svg.Chart("t", svg.Axis("x"), svg.Axis("y"), tuple(marks), levels), 720))
    said = [t.text for t in root.iter("text") if t.get("class") == "label"]
    assert "Untouched: 100 ↑" in said and "Near" in said
    ticks = [t.text or "" for t in root.iter("text") if t.get("class") == "tick" and t.get("text-anchor") == "end"]
    assert max(map(float, ticks)) == 40 and len([p for p in root.iter("path") if p.get("class") == "level"]) == 1


def test_svg_puts_points_where_the_axes_say():
    chart = svg.Chart("t", svg.Axis("x"), svg.Axis("y"), (svg.Series("a", 0, (svg.Mark(0, 1), svg.Mark(10, 3)), True),))
    root = ET.fromstring(svg.draw(chart, 720))
    ticks = {t.text: t for t in root.iter("text") if t.get("class") == "tick" and t.get("text-anchor") == "middle"}
    zero, ten = (float(ticks[text].get("x", "")) for text in ("0", "10"))
    path = next(p.get("d", "") for p in root.iter("path") if p.get("class") == "line m0")
    ends = [tuple(map(float, point.split(","))) for point in path[1:].split("L")]
    assert [end[0] for end in ends] == pytest.approx([zero, ten], abs=0.15) and ends[0][1] > ends[1][1]


def test_a_file_of_a_chart_stands_alone():
    root = ET.fromstring(svg.document(svg.draw(crowd(3, False), 720)))
    assert root.tag == "{http://www.w3.org/2000/svg}svg" and "prefers-color-scheme" in "".join(root.itertext())


def test_all_styles_differ():
    pairs = {(k % len(svg.COLORS), k % len(svg.SHAPES)) for k in range(35)}
    assert len(pairs) == 35


def test_a_chart_of_nothing_is_an_error():
    bare = svg.Chart("Empty", svg.Axis("x"), svg.Axis("y"), (svg.Series("a", 0, (svg.Mark(1, math.nan),)),))
    with pytest.raises(ValueError, match="chart 'Empty': expected at least one point"):
        svg.draw(bare, 720)


def test_quality_against_seconds_has_points_curves_and_levels():
    def curve(gain: float) -> list[dict[str, float | None]]:
        return [{"seconds": s * gain, "steps": s, "psnr": 10.0 + gain} for s in (10, 30, 100)]

    told = [record("nothing", n, 15, edit_seconds=0.0) for n in "ab"] + [record("ttt", n, 20) for n in "ab"]
    told += [record("3dgs", "a", 18, edit_seconds=300.0, curve=curve(1.0))]
    told += [record("3dgs", "b", 22, edit_seconds=500.0, curve=curve(2.0)[:2])]
    names = Names.of(METHODS, {r.method for r in told})
    chart = plots.against_seconds(summarize(told), told, COLUMNS[0], names)
    assert chart is not None and chart.x.log
    assert [(level.label, level.y) for level in chart.levels] == [("Asset as it is", 15)]
    by_name = {s.label: s for s in chart.series}
    assert [(m.x, m.y) for m in by_name["Ours (TTT)"].marks] == [(1, 20)] and not by_name["Ours (TTT)"].joined
    # steps that both cases have: 10 and 30; medians of seconds (10, 20) and (30, 60), means of figures (11, 12)
    assert [(m.x, m.y) for m in by_name["3DGS"].marks] == [(15, 11.5), (45, 11.5), (400, 20)]


def test_quality_against_views_is_in_order_and_apart():
    told = [record("ttt", f"{n}-{v}", 20 + v, facts={"views": v}) for n in "ab" for v in (4, 1, 2)]
    told += [record("3dgs", f"{n}-{v}", 10 + v, facts={"views": v}) for n in "ab" for v in (4, 1, 2)]
    found = plots.charts(told, FakeTable(split_by="views"), Names.of(METHODS, {"ttt", "3dgs"}))
    assert [chart.title for chart in found] == [
        "PSNR against seconds (views 4)",
        "PSNR against number of views",
    ]
    lines = found[1].series
    assert [[m.y for m in s.marks] for s in lines] == [[21, 22, 24], [11, 12, 14]]
    assert [value for value, _ in found[1].x.ticks] == [1, 2, 4]
    assert all(abs(m.x - v) < 0.25 for s in lines for m, v in zip(s.marks, (1, 2, 4), strict=True))


def test_steps_in_a_row_and_rows_at_each_stage():
    stages = {"gaussians_before": 1000.0, "gaussians_kept": 250.0}
    told = [record(method, n, 20, numbers=stages) for method in ("ttt", "3dgs") for n in "ab"]
    for k, r in enumerate(told):
        r.figures.update({f"psnr_{step}": 30.0 - step + k % 2 for step in (1, 2, 10)}, ssim_1=0.5)
    found = {c.title: c for c in plots.charts(told, FakeTable(), Names.of(METHODS, {"ttt", "3dgs"}))}
    assert set(found) == {"PSNR against seconds", "PSNR after each step", "Rows at each stage"}
    first = found["PSNR after each step"].series[0].marks
    assert [(round(m.x), m.y) for m in first] == [(1, 29.5), (2, 28.5), (10, 20.5)]
    assert plots.charts(told[:2], FakeTable(), Names.of(METHODS, {"ttt"})) == [], "one method is no comparison"
    assert [m.y for m in found["Rows at each stage"].series[0].marks] == [1000, 250, 100]
