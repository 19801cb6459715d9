"""Scene files: what is written comes back, and what cannot be read says so in one line."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from relevance.scene import (
    Box,
    Camera,
    Light,
    Robot,
    Scene,
    SceneError,
    Table,
    Texture,
    read_scenes,
    scene_from_json,
    scene_to_json,
)

CASES = Path(__file__).parent / "cases"
RED = {"name": "red", "size": [0.05, 0.05, 0.06], "position": [0.02, 0.2, 0.03], "color": [1, 0, 0]}
BLUE = {**RED, "name": "blue", "position": [0.02, -0.1, 0.03], "color": [0, 0, 1]}


def raw(**changes) -> dict:
    return {"id": "s1", "objects": [dict(RED), dict(BLUE)], "goals": ["on(red, blue)"]} | changes


def red(**changes) -> dict:
    return raw(objects=[RED | changes, dict(BLUE)], goals=[])


def read(path: Path, content: str | bytes | dict) -> list[Scene]:
    if isinstance(content, dict):
        content = json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_scenes(path)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "s.json"


def refusal(path: Path, content: str | bytes | dict) -> str:
    with pytest.raises(SceneError) as caught:
        read(path, content)
    message = str(caught.value)
    assert message.startswith(f"{path}")
    assert message.isprintable()
    return message.removeprefix(str(path))


# ---------------------------------------------------------------- cases that failed


@pytest.mark.parametrize(
    ("name", "ids"),
    [
        ("u2028-two.jsonl", ["tray\u2028one", "s2"]),
        ("bom.jsonl", ["s1", "s2"]),
        ("bom-one.json", ["s1"]),
        ("nfd-names.jsonl", ["nfd"]),
        ("sunk-0.5mm.jsonl", ["sunk-0.5mm"]),
        ("sunk-0.6mm.jsonl", ["sunk-0.6mm"]),
        ("sunk-0.8mm.jsonl", ["sunk-0.8mm"]),
    ],
)
def test_cases_that_are_read(name, ids):
    assert [scene.id for scene in read_scenes(CASES / name)] == ids


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pretty-two.json", "neither one JSON value (Extra data at line 47"),
        ("comment.jsonl", "neither one JSON value"),
        ("dupkey.jsonl", "jsonl:1: objects.0.yaw: given twice"),
        ("strings.jsonl", "jsonl:1: objects.0.size.0: Input should be a valid number"),
        ("bools.jsonl", "jsonl:1: objects.0.color.0: Input should be a valid number (found True)"),
        ("dupid.jsonl", "jsonl:2: id 's1' is that of"),
        ("trailing-space-name.jsonl", "objects.0.name: expected no blanks at its ends"),
        ("newline-name.jsonl", "objects.0.name: expected printable characters, found U+000A"),
        ("escape-id.jsonl", "id: expected printable characters, found U+001B"),
        ("emptylist.json", "json: has no scenes"),
        ("box-in-robot.jsonl", "objects.0 ('a'): stands in the robot"),
        ("eye-is-target.json", "camera: target [0.5, 0.0, 0.5] is where the eye is"),
        ("light-zero.json", "light: direction [0.0, 0.0, 0.0]"),
        ("plate-on-pillars.json", "objects.5 ('base2'): floating or falling over"),
    ],
)
def test_cases_that_are_refused_in_one_line(name, expected):
    with pytest.raises(SceneError) as caught:
        read_scenes(CASES / name)
    message = str(caught.value)
    assert message.startswith(str(CASES / name))
    assert expected in message
    assert message.isprintable()
    assert len(message) < 2 * len(str(CASES / name)) + 300


# ---------------------------------------------------------------- text


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n \r\n\t\n",
        "\ufeff".encode(),
        b"null",
        b"3",
        b'"a scene"',
        b"true",
        b"[1, 2]",
        b"[[]]",
        b"[null]",
        b"{}",
        b"{",
        b"[",
        b"not json",
        b"\xff\xfe{\x00}\x00",
        b"\xef\xbb",
        b"\x00",
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b'{"id": ' + b"9" * 5000 + b"}",
        b'{"id": "s1"}\r{"id": "s2"}',
        b"NaN",
        b"// nothing else",
    ],
)
def test_what_holds_no_scene_is_refused_in_one_short_line(file, content):
    assert len(refusal(file, content)) < 300


def test_text_is_utf_8_whatever_the_locale(file):
    text = json.dumps(raw(objects=[RED | {"name": "rötlich"}, BLUE], goals=[]), ensure_ascii=False)
    for content in (text.encode(), b"\xef\xbb\xbf" + text.encode(), text.encode() + b"\r\n"):
        assert read(file, content)[0].names == ("rötlich", "blue")
    assert "UTF-8" in refusal(file, text.encode("latin-1"))
    assert "UTF-8" in refusal(file, text.encode("utf-16"))


@pytest.mark.parametrize("mark", ["\u2028", "\u2029", "\x85", "\x0b", "\x0c", "\x1c"])
def test_lines_end_at_a_line_feed_alone(file, mark):
    lines = [json.dumps(raw(goals=[f"on(red, blue){blank}"])) for blank in ("", " ")]
    spaced = [
        line.replace('"objects": ', f'"objects":{blank}')
        for line, blank in zip(lines, ("\r", "\t"), strict=True)
    ]
    spaced[1] = spaced[1].replace('"s1"', '"s2"')
    assert [scene.id for scene in read(file, "\n".join(spaced))] == ["s1", "s2"]
    # Raw inside a string, the mark is part of a word (or refused as one), never a line's end.
    message = refusal(file, json.dumps(raw(name=mark), ensure_ascii=False).encode())
    assert ":1: " in message


def test_standard_input(monkeypatch):
    text = json.dumps(raw()).encode()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text), encoding="ascii"))
    assert [scene.id for scene in read_scenes("-")] == ["s1"]
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"{"), encoding="ascii"))
    with pytest.raises(SceneError, match=r"^standard input:1: "):
        read_scenes("-")


def test_what_is_no_file(tmp_path):
    for path in (tmp_path, tmp_path / "none.json", tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(SceneError, match="cannot be read") as caught:
            read_scenes(path)
        assert str(caught.value).isprintable()
    with pytest.raises(SceneError, match=r"a\\nb.*cannot be read"):
        read_scenes(tmp_path / "a\nb")


def test_an_error_shows_its_surroundings_not_the_whole_line(file):
    long = json.dumps(raw(goals=["on(red, blue)"] * 1000))
    broken = long[:9000] + "@" + long[9000:]
    message = refusal(file, json.dumps(raw(id="s0")) + "\n" + broken)
    assert message.startswith(":2: ")
    assert len(message) < 200
    assert "column 9" in message
    assert len(refusal(file, red(name="x" * 5000))) < 200
    assert len(refusal(file, raw(goals=["y" * 5000]))) < 200
    assert len(refusal(file, raw(**{"z" * 5000: 1}))) < 300


# ---------------------------------------------------------------- keys, numbers, words


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('"id": "s1", "id": "s1"', "id"),
        ('"camera": {"fov": 40, "width": 320, "fov": 40}', "camera.fov"),
        ('"table": {"texture": {"kind": "noise", "kind": "checks"}}', "table.texture.kind"),
        ('"unknown": [[{"a\\n": 1, "a\\n": 2}]]', r"unknown.0.0.a\n"),
    ],
)
def test_a_key_given_twice_at_any_depth(file, text, key):
    inner = json.dumps(raw())[1:-1].replace('"id": "s1", ', "")
    assert f"{key}: given twice" in refusal(file, f"{{{inner}, {text}}}")


NUMBERS = [
    "objects.0.size.1", "objects.0.position.2", "objects.0.color.0", "objects.0.yaw",
    "table.size.0", "table.texture.scale", "table.texture.seed", "camera.eye.0", "camera.width",
    "camera.fov", "camera.near", "light.direction.2", "light.distance", "light.ambient",
    "robot.base.1", "robot.yaw",
]  # fmt: skip
FULL = raw(
    objects=[RED | {"yaw": 0.1}, BLUE],
    table={"size": [0.8, 1.2], "texture": {"kind": "noise", "color": [0, 0, 0], "scale": 0.1,
                                           "seed": 3}},
    camera={"eye": [-0.66, 0, 0.66], "width": 320, "fov": 47, "near": 0.04},
    light={"direction": [0, 0, 1], "distance": 2, "ambient": 0.5},
    robot={"base": [-0.48, 0, 0], "yaw": 0},
)  # fmt: skip


@pytest.mark.parametrize("field", NUMBERS)
def test_numbers_are_numbers(file, field):
    read(file, FULL)
    for wrong in ("1", "", True, None, [1], {}, float("nan"), float("-inf"), 10**400, 1e300):
        data = json.loads(json.dumps(FULL))
        *path, last = field.split(".")
        at = data
        for key in path:
            at = at[int(key) if key.isdigit() else key]
        at[int(last) if last.isdigit() else last] = wrong
        message = refusal(file, data)
        assert field in message
        assert len(message) < 200


@pytest.mark.parametrize("value", ["false", 0, "yes"])
def test_a_shadow_is_true_or_false(file, value):
    assert "light.shadow" in refusal(file, raw(light={"shadow": value}))


UNPRINTABLE = [0x00, 0x07, 0x09, 0x0A, 0x0D, 0x1B, 0x7F, 0x85, 0xAD, 0x200B, 0x200D, 0x200E, 0x202E,
               0x2066, 0xFEFF, 0xD800, 0xDFFF, 0xE000, 0xFFFF]  # fmt: skip


@pytest.mark.parametrize("code", UNPRINTABLE)
def test_words_are_printable(file, code):
    word = f"a{chr(code)}b"
    assert f"name: expected printable characters, found U+{code:04X}" in refusal(
        file, red(name=word)
    )
    assert f"id: expected printable characters, found U+{code:04X}" in refusal(file, raw(id=word))
    assert "'on': expected" not in refusal(file, red(on=word))
    refusal(file, raw(goals=[f"on({word}, blue)"]))
    refusal(file, raw(goals=[f"{word}(red, blue)"]))
    refusal(file, raw(**{word: 1}))


@pytest.mark.parametrize("blank", [" ", "\t", "\u00a0", "\u3000", "\n"])
def test_words_have_no_blanks_at_their_ends(file, blank):
    for word in (f"red{blank}", f"{blank}red", blank):
        assert "objects.0.name: expected no blanks" in refusal(file, red(name=word))
        assert "id: expected no blanks" in refusal(file, raw(id=word))


def test_words_are_compared_in_one_form(file):
    composed, apart = "r\u00f6t", "ro\u0308t"
    scene = read(file, raw(objects=[RED | {"name": apart}, BLUE], goals=[f"on({apart}, blue)"]))[0]
    assert scene.names == (composed, "blue")
    assert scene.goals == (f"on({composed}, blue)",)
    assert scene[apart] is scene[composed]
    assert scene.goal(f"behind({apart}, blue)").subject == composed
    both = [RED | {"name": apart}, BLUE | {"name": composed}]
    assert "name is taken" in refusal(file, raw(objects=both, goals=[]))


def test_ids_are_distinct(file):
    lines = [json.dumps(raw()), json.dumps(raw(id="s2")), json.dumps(raw())]
    assert ":3: id 's1' is that of" in refusal(file, "\n".join(lines))
    assert "[1]: id 's1' is that of" in refusal(file, json.dumps([raw(), raw()]))
    nameless = json.dumps({k: v for k, v in raw().items() if k != "id"})
    assert "named by its content" in refusal(file, f"{nameless}\n{nameless}")


# ---------------------------------------------------------------- properties

letters = st.characters(exclude_categories=["C", "Z"], exclude_characters="(),")
words = st.text(letters, min_size=1, max_size=8)
ids = st.text(letters | st.sampled_from("(), \u2028\u2029"), max_size=8)
units = st.floats(0, 1)
small = st.floats(-0.2, 0.2)
colors = st.tuples(units, units, units)


@st.composite
def scenes(draw) -> Scene:
    size = st.tuples(*[st.floats(1e-3, 0.2)] * 3)
    objects = []
    for x in (-0.15, 0.2):
        edges = draw(size)
        z = edges[2] / 2 + draw(st.floats(-2e-4, 2e-4))
        objects.append(
            {
                "name": draw(words),
                "size": edges,
                "position": (x, draw(small), z),
                "yaw": draw(st.floats(-50, 50)),
                "color": draw(colors),
            }
        )
    texture = {"kind": draw(st.sampled_from(["checks", "noise"])), "color": draw(colors),
               "scale": draw(st.floats(0.01, 1))}  # fmt: skip
    first, second = (item["name"] for item in objects)
    try:
        return Scene(
            id=draw(ids),
            objects=tuple(Box(**item) for item in objects),
            goals=draw(st.sampled_from([(), (f"on({first},{second})",)])),
            table=Table(texture=draw(st.sampled_from([None, Texture(**texture)]))),
            camera=Camera(fov=draw(st.floats(1, 170)), eye=(-0.6, draw(small), 0.7)),
            light=Light(ambient=draw(st.floats(0.1, 1)), shadow=draw(st.booleans())),
            robot=Robot(yaw=draw(st.floats(-9, 9))),
        )
    except SceneError:
        assume(False)
        raise


@given(scenes())
@settings(deadline=None, suppress_health_check=list(HealthCheck))
def test_every_scene_that_is_accepted_comes_back(tmp_path_factory, scene):
    path = tmp_path_factory.mktemp("scenes") / "s.jsonl"
    text = scene_to_json(scene)
    assert len(text.splitlines()) == 1
    again = read(path, text + "\n")
    assert again == [scene]
    assert hash(again[0]) == hash(scene)
    assert scene_to_json(again[0]) == text


def check(text: str | bytes) -> None:
    """It is a scene that comes back, or is refused in one short line."""
    try:
        scene = scene_from_json(text, where="here")
    except SceneError as error:
        message = str(error)
    else:
        assert scene_from_json(scene_to_json(scene)) == scene
        return
    assert message.startswith("here: ")
    assert message.isprintable()
    assert len(message) < 400


jsons = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


@given(
    st.sampled_from(
        [
            *NUMBERS,
            "id",
            "goals",
            "goals.0",
            "objects",
            "objects.0",
            "objects.1.on",
            "objects.1.name",
            "table",
            "camera",
            "light.shadow",
            "new",
        ]
    ),
    jsons,
)
@settings(deadline=None, max_examples=300)
def test_any_value_anywhere_is_read_or_refused_in_one_line(field, value):
    data = json.loads(json.dumps(FULL))
    *path, last = field.split(".")
    at = data
    for key in path:
        at = at[int(key) if key.isdigit() else key]
    at[int(last) if last.isdigit() else last] = value
    check(json.dumps(data))


@given(st.integers(0, 600), st.integers(0, 600), st.binary(max_size=4))
@settings(deadline=None, max_examples=300)
def test_any_text_is_read_or_refused_in_one_line(start, stop, piece):
    text = json.dumps(FULL).encode()
    mangled = text[:start] + piece + text[stop:]
    check(mangled)
