"""The report is one page that needs nothing from outside and runs nothing but its own script."""

from __future__ import annotations

import base64
import hashlib
import html.parser
import json
import re
from datetime import datetime

import numpy as np
import pytest

from gcar_deploy.output.bundle import render_files
from gcar_deploy.output.report import _embedded, report_html
from gcar_deploy.output.words import LEFT_OUT


class Page(html.parser.HTMLParser):
    """Collects tags, scripts and what would be fetched."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.bodies: dict[str, list[str]] = {"script": [], "style": []}
        self._inside: str | None = None

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in self.bodies:
            self._inside = tag
            self.bodies[tag].append("")

    def handle_endtag(self, tag):
        if tag == self._inside:
            self._inside = None

    def handle_data(self, data):
        if self._inside:
            self.bodies[self._inside][-1] += data


@pytest.fixture(scope="session")
def text(files):
    return files["report.html"].decode("utf-8")


@pytest.fixture(scope="session")
def page(text):
    parsed = Page()
    parsed.feed(text)
    return parsed


def test_status_comes_first(text, result):
    body = text.split("<body>")[1]
    visible = re.sub(r"<[^>]+>", " ", body).split()
    assert visible[0] == result.status


def test_the_day_is_told_and_no_other_file_changes_with_it(result, files, text):
    told = re.search(r"written <b>(\d{4}-\d\d-\d\d \d\d:\d\d [+-]\d{4})</b>", text).group(1)
    age = datetime.now().astimezone() - datetime.strptime(told, "%Y-%m-%d %H:%M %z")
    assert 0 <= age.total_seconds() < 3600
    again = render_files(result)
    changed = {name for name in files if files[name] != again[name]}
    assert changed in (set(), {"report.html", "result.json"})  # whose list holds the report's hash
    one, other = (json.loads(every["result.json"]) for every in (files, again))
    del one["files"]["report.html"], other["files"]["report.html"]
    assert one == other


@pytest.mark.req("REQ-38")
def test_nothing_is_fetched(page, text):
    for tag, attributes in page.tags:
        for name in ("src", "href", "action", "srcset", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:"), (tag, name, value)
    assert "http:" not in text and "https:" not in text and "@import" not in text


@pytest.mark.req("REQ-38")
def test_policy_allows_exactly_the_own_script_and_style(page):
    policy = next(
        a["content"] for tag, a in page.tags
        if tag == "meta" and a.get("http-equiv") == "Content-Security-Policy"
    )  # fmt: skip
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy
    run = [b for (t, a), b in zip(
        [x for x in page.tags if x[0] == "script"], page.bodies["script"], strict=True
    ) if "type" not in a]  # fmt: skip
    for body in [*run, *page.bodies["style"]]:
        digest = base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        assert f"'sha256-{digest}'" in policy
    for _, attributes in page.tags:
        assert not any(name.startswith("on") or name == "style" for name in attributes)


def test_data_are_the_tree(page, result, text):
    data = json.loads(page.bodies["script"][0])
    assert len(data["branches"]) == len(result.tree.branches)
    assert len(data["branches"][0]["points"]) == len(result.tree.branches[0])
    # The two directions and the best further one.
    assert len(data["views"]) == 3
    further = result.summary()["best_further_view"]
    assert data["views"][2] == [further["primary_angle_deg"], further["secondary_angle_deg"]]
    assert further["name"] in text


def test_research_use_is_said_and_size_is_small(text):
    assert "Research use only" in text
    assert len(text) < 500_000


def test_what_was_left_out_is_in_legend_and_caption(result, text):
    assert LEFT_OUT not in text and "was left out" not in text
    summary = result.summary()
    summary["views"][1] |= {"coverage": 0.93, "coverage_even": 0.69, "left_out": 0.12}
    page = report_html(result, summary, [np.zeros((16, 16, 3), np.uint8)] * 2)
    assert page.count(LEFT_OUT) == 1
    told = "(93% weighed by thickness; 12% of what looks like vessel was left out);"
    assert page.count(f"69% of the length of the vessels seen is explained {told}") == 1


def test_the_headline_is_not_listed_once_more(result):
    summary = result.summary()
    summary["sentence"], summary["findings"] = "First (and 1 more).", ["first", "second"]
    page = report_html(result, summary, [np.zeros((16, 16, 3), np.uint8)] * 2)
    assert "<li>second</li>" in page and "<li>first</li>" not in page


def test_hostile_names_stay_text(result):
    summary = result.summary()
    summary["views"][0]["id"] = summary["views"][0]["name"] = "</script><img onerror=x>__DATA__"
    summary["sentence"] = "<script>alert(1)</script>"
    grey = np.zeros((16, 16, 3), np.uint8)
    parsed = Page()
    parsed.feed(report_html(result, summary, [grey, grey]))
    assert len([tag for tag, _ in parsed.tags if tag == "script"]) == 2
    assert not any("onerror" in attributes for _, attributes in parsed.tags)
    assert json.loads(_embedded("</script>")) == "</script>"
    assert "</script>" not in _embedded("</script>")
