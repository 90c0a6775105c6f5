"""Scripts from before a session had parts go on working, and are told the present names."""

from __future__ import annotations

import copy
import inspect
import operator
import re
from pathlib import Path

import pytest

from splatpainter.session import Session
from splatpainter.session.former_names import PRESENT_NAMES
from tests.support.session_scenes import dab, flat, load

BEFORE_PARTS = """
add(kind,edits,name,mode,method,parameters,opacity,blend,index,attached,asset)
add_asset(asset,name,placement,frame) add_bookmark(name,camera) aside(layer) asset(asset) asset_original(asset)
asset_splats(asset) assets below(layer) blend_preview(layer,opacity,blend,visible) blob(sha256) bookmarks()
close() confidence(layer) conflicts() copy(relief,name,index) coverage() cursor decal_map(decal,camera,replaces)
delete(layer) delete_bookmark(bookmark) delete_selection(name) delta(since) duplicate(layer)
erase_more(layer,edits,name) erases_on(layer,cameras) export(path,overwrite,remove_hidden,asset,options)
export_layer(layer,path,overwrite) export_view(path,camera,bits,transparent,aovs,profile,overwrite)
exported(remove_hidden,asset) facts(layer) fill(weights,remove,body,name) fill_from(layer,edits,source,name)
filled_by(layer) first_stroke(layer_name,edits,name) front has_its_file has_picture hide(weights,name,index)
history import_layer(path,asset) jump(cursor) laid(decal,replaces) layer(layer) layers left_out(camera)
load(project,painter,adjustments,readonly,original,embedded,folder) mask_area(layer,camera,shows)
mask_selection(layer,weights) match_seam(asset,to,falloff) merge(layers,name) move(layer,index)
new_layer(name,index,asset) note opened oriented original paint(layer,edits,name,kind,method,parameters)
paint_mask(layer,camera,shows,share,name) painted(name) painted_on(layer) path prepare(camera) read_only receipt()
redo() refresh() remove_asset(asset) replace_views(layer,edits,name,parameters,gesture,attached)
resolve_conflict(lower,upper,policy) save_as(path,overwrite) save_copy(path,overwrite)
save_selection(name,weights) selected_parts(weights) selection(name) selections() set(layer,gesture)
set_asset(asset,gesture) set_front(camera) set_mask(layer,mask,what,gesture) set_picture(png) set_up(up)
settle(lower,upper,policy) shown snapshot splats surface surface_blocks(camera) undo() up verify(repaint) version
"""
"""What a Session offered then, written down from its class: methods with their parameters, and values."""
CALLS = {name: given if called else None for name, called, given in re.findall(r"(\w+)(\(([\w,]*)\))?", BEFORE_PARTS)}
OF_ANOTHER_MEANING = {"copy"}
"""Takes another value now."""
PRESENT_PARAMETERS = {"kind": "what", "frame": "axes"}
GONE_PARAMETERS = {"parameters"}
"""Of `add`, `paint` and `replace_views`: their keys are keywords now."""


def test_every_name_from_before_the_parts_still_answers() -> None:
    with flat() as session:
        here = set(dir(session))
        missing = set(CALLS) - here - set(PRESENT_NAMES)
        assert missing == OF_ANOTHER_MEANING
        assert not here & set(PRESENT_NAMES)  # else the table would never be asked
        assert set(PRESENT_NAMES) <= set(CALLS)


@pytest.mark.parametrize("old", PRESENT_NAMES)
def test_an_old_name_is_what_the_present_one_is_and_says_so(old: str) -> None:
    present = PRESENT_NAMES[old]
    with flat() as session:
        with pytest.warns(DeprecationWarning, match=rf"^session\.{old} is now session\.{present}$") as warned:
            value = getattr(session, old)
        assert warned[0].filename == __file__
        assert value == operator.attrgetter(present)(session)
        # What could be given then can be given now, under the same name.
        assert callable(value) == (CALLS[old] is not None)
        if callable(value):
            now = inspect.signature(value).parameters
            names = {name for name in (CALLS[old] or "").split(",") if name} - GONE_PARAMETERS
            lost = {name for name in names if not {name, PRESENT_PARAMETERS.get(name)} & set(now)}
            assert not lost or (lost <= {"mode", "method"} and "options" in now)


@pytest.mark.filterwarnings("ignore:session:DeprecationWarning")
def test_a_script_of_then_runs(tmp_path: Path) -> None:
    with flat(project=tmp_path / "p.splatproj") as session:
        script: object = session
        then = operator.methodcaller
        layer = then("add", "paint", [dab()], name="x")(script)
        assert [layer.name for layer in session.layers] == ["x"]
        then("set", layer.id, opacity=0.5)(script)
        assert session.layers[0].opacity == 0.5
        assert session.undo() and session.undo() and session.redo()
        assert then("layer", layer.id)(script).opacity == 1
        then("export", tmp_path / "out.ply", overwrite=True)(script)
        then("save_as", tmp_path / "q.splatproj")(script)
        assert (tmp_path / "out.ply").stat().st_size > 0
    with load(tmp_path / "q.splatproj") as session:
        assert len(session.layers) == 1 and not session.read_only


def test_other_names_are_as_unknown_as_ever() -> None:
    with flat() as session:
        with pytest.raises(AttributeError, match=r"^'Session' object has no attribute 'sett'$") as error:
            operator.attrgetter("sett")(session)
        assert error.value.name == "sett" and error.value.obj is session
        assert not hasattr(session, "__array__") and not hasattr(session, "_repr_html_")
        assert copy.copy(session).layers is session.layers
    # One without parts yet, as copying and unpickling make it.
    bare = object.__new__(Session)
    assert not hasattr(bare, "__setstate__") and not hasattr(bare, "add")
