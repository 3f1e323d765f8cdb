"""The page holds everything, loads nothing, and escapes what it is given."""

import html.parser
import sys

import numpy as np
import pytest

from jaxrender.io import picture
from jaxrender.io.report import Report, format_cell

HOSTILE = "<script>alert('x')</script> & \"quotes\""


class Page(html.parser.HTMLParser):
    """Collects tags, attributes and text, and complains about tags that do not close."""

    VOID = frozenset({"meta", "img"})

    def __init__(self, source):
        super().__init__()
        self.tags, self.text, self.open = [], "", []
        self.feed(source)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def make_page(tmp_path):
    image = np.linspace(0, 1, 48).reshape(4, 4, 3)
    picture.write_animation(tmp_path / "a.webp", [image, image[::-1]])
    report = Report("Title", subtitle=HOSTILE)
    report.section("One " + HOSTILE).text(HOSTILE + "\n\nsecond").note(HOSTILE).facts({HOSTILE: HOSTILE})
    report.section("Two").image(image, HOSTILE).image(tmp_path / "a.webp").images([(image, "a"), (image, "b")], HOSTILE)
    report.subsection("Sub").table([{"a": 1, HOSTILE: HOSTILE}, {"a": None}], caption=HOSTILE, best={"a": "min"})
    report.section("Three").plot(lambda figure: figure.subplots().plot([0, 1], label=HOSTILE), HOSTILE)
    return report


def test_page_is_well_formed_and_loads_nothing(tmp_path):
    pytest.importorskip("matplotlib")
    page = Page(make_page(tmp_path).html())
    tags = [tag for tag, _ in page.tags]
    assert "script" not in tags and "link" not in tags and "iframe" not in tags
    for tag, attributes in page.tags:
        for name in ("src", "href", "xlink:href"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, value)
        assert not any(name.startswith("on") for name in attributes)
    assert page.text.count("<script>") >= 8  # as text, everywhere it was given
    policy = next(a["content"] for t, a in page.tags if t == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy


def test_images_are_inlined_by_content(tmp_path):
    page = Page(make_page(tmp_path).html())
    kinds = [a["src"].split(";")[0] for t, a in page.tags if t == "img"]
    assert kinds == ["data:image/png", "data:image/webp", "data:image/png", "data:image/png"]
    (tmp_path / "x.svg").write_text("<svg onload='x'/>")
    with pytest.raises(ValueError, match="expected a PNG, GIF, WebP or JPEG file"):
        Report("t").image(tmp_path / "x.svg")


def test_contents_list_appears_with_three_sections(tmp_path):
    links = [a["href"] for t, a in Page(make_page(tmp_path).html()).tags if t == "a"]
    assert links == ["#s1", "#s2", "#s3"]
    assert "<nav" not in Report("t").section("a").section("b").html()


def test_table_alignment_and_best():
    report = Report("t").table([["x", 2.0, 5], ["y", 1.0, None]], ["name", "error", "count"], best={"error": "min"})
    source = report.html()
    assert '<td class="number"><strong>1.000</strong></td>' in source
    assert '<td class="number">2.000</td>' in source
    assert '<td>x</td><td class="number">' in source
    with pytest.raises(ValueError, match="expected 3 values in a row, got 1"):
        Report("t").table([["x"]], ["name", "error", "count"])
    with pytest.raises(ValueError, match="columns: expected names"):
        Report("t").table([["x"]])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (True, "yes"), (1234567, "1\u202f234\u202f567"), (0.0, "0"), (0.123456, "0.1235"),
        (12.3456, "12.35"), (-3.5, "−3.500"), (1.2e-6, "1.2e−06"), (float("inf"), "∞"), (float("nan"), "NaN"),
        (98765.4, "98\u202f765"), (2.5e9, "2.5e+09"), ("text", "text"), (np.float32(0.5), "0.5000"),
    ],
)  # fmt: skip
def test_format_cell(value, text):
    assert format_cell(value) == text


def test_plots_take_figures_and_follow_the_colors_of_the_page(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    figure = matplotlib.figure.Figure((4, 3))
    figure.subplots().plot([1, 2], [3, 4])
    source = Report("t").plot(figure).plot(lambda f: f.subplots().set(title="drawn", xlabel="x")).html()
    assert source.count("<svg") == 2 and "drawn" in source
    assert "var(--text)" in source and "#010203" not in source and "#040506" not in source
    assert "viewBox" in source.split("<svg", 1)[1].split(">", 1)[0]


def test_same_content_same_bytes(tmp_path):
    assert make_page(tmp_path).html() == make_page(tmp_path).html()


def test_without_matplotlib_a_line_stands_in(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    source = Report("t").plot(lambda figure: pytest.fail("must not be drawn"), "Caption.").html()
    assert "matplotlib is not installed" in source and "Caption." in source


def test_write_returns_the_path_and_leaves_one_file(tmp_path):
    path = Report("t").text("ä ∞").write(tmp_path / "deep" / "report.html")
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]
