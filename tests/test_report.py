"""The pages: what they say, that they stand alone, and that a real browser shows them without a complaint."""

import dataclasses as dc
import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import review_samples as sample

from valve_drake.analysis import plots, report, two_logs
from valve_drake.analysis.curves import make_plots
from valve_drake.analysis.pictures import Album
from valve_drake.messages import ModeState
from valve_drake.pace import PACE, Pace
from valve_drake.recording.writer import LogWriter

BROWSER = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    sample.write_run(folder / "run.mcap")
    (folder / "run.html").write_text("<!doctype html>the 3D recording", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def review(folder):
    return report.review(folder / "run.mcap")


@pytest.fixture(scope="module")
def page(review, folder):
    return report.page(review, folder)


@pytest.fixture(scope="module")
def other(folder):
    """The same run at another friction, but from 2 s on the right hand's servo error is 1 mm larger."""

    def change(topic, message, t):
        if topic == "/image_servo/servo" and t >= 2.0:
            return dc.replace(message, right_error=message.right_error + [0.001, 0, 0])
        return message

    return report.review(
        sample.write_run(folder / "other.mcap", change=change, scenario=sample.SCENARIO.replace("5.1", "7.3"))
    )


class Balance(html.parser.HTMLParser):
    """Every tag that is opened is closed, in order."""

    VOID = {"meta", "img", "br", "link", "input"}

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.faults = [], [], []

    def handle_starttag(self, tag, attributes):
        self.ids += [value for key, value in attributes if key == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(tag)


def check_markup(page):
    parser = Balance()
    parser.feed(page)
    assert parser.faults == [] and parser.open == []
    assert len(parser.ids) == len(set(parser.ids))


def check_stands_alone(page):
    for address in re.findall(r"""(?:src|href|url)\s*[=(]\s*["']?([^"')>\s]+)""", page):
        assert address.startswith("data:image/jpeg;base64,") or address.endswith(".html"), address[:60]
    assert "@import" not in page and "default-src 'none'" in page


def test_the_page_is_sound_markup_and_stands_alone(page):
    check_markup(page)
    check_stands_alone(page)


def test_the_page_says_outcome_verdict_reason_numbers_and_what_was_run(page):
    for words in ("done: turned", "camera sees 57.30 deg", "57.30°", "20.0 N", "friction: 5.1", "fffffffff", "Seed 7"):
        assert words in page, words
    assert 'href="run.html"' in page


def test_the_page_says_that_the_log_is_whole_and_which_topics_have_no_rate(page):
    assert "Every CRC matches, no message is missing" in page and "Every topic with a rate kept it" in page
    row = page[page.index('<td class="mono">/head_left/image') :][:600]
    assert "with the cameras" in row and "none" in row
    assert "on change" in page[page.index('<td class="mono">/events') :][:600]
    assert "128 Hz" in page[page.index('<td class="mono">/joint_states') :][:600]


def test_the_page_shows_every_mode_with_reason_and_retry_and_escapes_what_the_log_says(page):
    assert page.count('class="bar"') == len(sample.MODES)
    assert page.count("retry 1") >= 2  # bar and table
    assert "marker &lt;2 m&gt; away" in page and "<2 m>" not in page
    assert "base: late" in page


def test_all_plots_are_there_with_the_modes_behind_them(page):
    wanted = (
        "distance position_error angle_error servo_error servo_speed forces couple"
        " valve_angle angle_error_valve tracking health"
    ).split()
    assert re.findall(r'<figure id="plot-(\w+)"', page) == wanted
    for key in wanted:
        figure = page[page.index(f'id="plot-{key}"') :].split("</figure>")[0]
        assert figure.count('class="m-') == len(sample.MODES)
        assert len(re.findall(r'class="(?:line|dots|dashed|rings)" stroke="#\w+" d="M', figure)) >= 1, key
    assert page.count('class="band"') >= 6  # of position and angle


def test_pictures_are_there_for_every_change_of_mode_that_had_some_and_for_the_worst_estimate(review, page):
    assert "worst estimate" in page
    album = Album(review.log)
    assert album.cameras == ["head_left", "head_right"]
    moments = album.changes_of_mode(review.traces.spans)
    assert [m.title for m in moments][:2] == ["search \u2192 measure", "measure \u2192 servo"]
    first = moments[0].thumbnails
    assert [t.camera for t in first] == ["head_left", "head_right"]
    assert first[0].time == pytest.approx(0.9375 - sample.TICK) and first[0].size == (320, 240)
    assert "polygon" in first[0].overlay and first[1].overlay == ""
    shown = [(t.camera, t.time) for m in moments for t in m.thumbnails]
    assert len(shown) == len(set(shown))
    assert page.count("<img") >= len(shown)


def test_an_image_that_cannot_be_decoded_is_said_so(tmp_path):
    def change(topic, message, t):
        if topic == "/head_left/image":
            message.data = b"not a JPEG"
        return message

    path = sample.write_run(tmp_path / "bad.mcap", end=2.0, change=change)
    assert "cannot be decoded" in report.page(report.review(path), tmp_path)


def test_a_damaged_log_has_its_page_that_says_what_is_missing_and_where(folder, tmp_path):
    data = bytearray((folder / "run.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "hurt.mcap").write_bytes(data)
    found = report.review(tmp_path / "hurt.mcap")
    page = report.page(found, tmp_path)
    check_markup(page)
    assert "<b>No.</b>" in page and "bytes are damaged after t" in page and 'class="gap"' in page
    facts = report.facts(found)
    assert not facts["sound"] and facts["lost"] > 0 and facts["damage"]


@pytest.mark.parametrize("keep", [0.03, 0.3, 0.9])
def test_a_log_that_was_cut_off_has_its_page(folder, tmp_path, keep):
    data = (folder / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(keep * len(data))])
    found = report.review(tmp_path / "cut.mcap")
    page = report.page(found, tmp_path)
    check_markup(page)
    assert "breaks off" in page and found.summary.outcome == "" and "unfinished" in page


def test_a_log_without_modes_or_of_another_program_has_its_page(tmp_path):
    with LogWriter(tmp_path / "bare.mcap") as writer:
        writer.write("/other", ModeState(), 0.0)
    page = report.page(report.review(tmp_path / "bare.mcap"), tmp_path)
    check_markup(page)
    assert "no <code>/supervisor/mode" in page and "/rectangle_estimator/estimate" in page


def test_the_page_says_how_real_time_was_kept(tmp_path):
    with LogWriter(tmp_path / "paced.mcap") as writer:
        for k in (1, 2):
            writer.write(PACE, Pace(time=k, ticks=128 * k, missed=3 * k, median=0.002, p99=0.0071, longest=0.030), k)
    found = report.review(tmp_path / "paced.mcap")
    page = report.page(found, tmp_path)
    check_markup(page)
    assert "6 of 256" in page and "p99 7.1" in page
    assert report.facts(found)["pace"]["p99_ms"] == pytest.approx(7.1)


def test_without_truth_the_position_wanders_about_its_median_within_its_band(tmp_path):
    found = report.review(sample.write_run(tmp_path / "blind.mcap", without=("/truth",)))
    plot = next(plot for plot in make_plots(found.traces) if plot.key == "position")
    assert [line.label for line in plot.lines] == ["x", "y", "z"]
    assert all(np.median(line.value) == pytest.approx(0.0, abs=1e-9) for line in plot.lines)
    assert all(1.0 - 1e-9 <= s <= 2.0 + 1e-9 for line in plot.lines for s in line.sigma)
    assert "No truth in this log" in report.page(found, tmp_path)


def test_the_page_is_the_same_every_time(review, folder, page):
    assert report.page(report.review(folder / "run.mcap"), folder) == page


def test_facts_are_plain_json(review):
    facts = json.loads(json.dumps(report.facts(review), allow_nan=False))
    assert facts["outcome"] == "done" and facts["angle_true_rad"] == pytest.approx(1.0)
    assert [m["mode"] for m in facts["modes"]] == [row[1] for row in sample.MODES]
    assert facts["scenario"]["simulation"]["valve"]["friction"] == 5.1
    assert {t["topic"] for t in facts["topics"]} == set(review.log.topics)
    assert facts["estimates"]["measure"]["position_rms_m"] == pytest.approx(0.003, abs=1e-6)


# ---------------------------------------------------------------- two logs


def test_the_first_divergence_is_found_to_topic_time_and_field(review, other):
    found = report.compare(review, other)
    assert (found.first.time, found.first.topic, found.first.field) == (2.0, "/image_servo/servo", "right_error[0]")
    facts = json.loads(json.dumps(report.comparison_facts(found), allow_nan=False))
    assert facts["first_divergence"]["time_s"] == 2.0 and not facts["identical"]
    assert facts["topics"]["/image_servo/servo"]["equal"] == 256
    assert facts["topics"]["/joint_states"]["first"] is None
    assert facts["settings"] == {"simulation.valve.friction": {"a": 5.1, "b": 7.3}}
    right = facts["numbers"]["servo_final_error_m.right"]
    assert right["difference"] == pytest.approx(0.001)
    assert facts["numbers"]["mode_durations_s.turn"]["difference"] == 0.0


def test_a_log_is_identical_to_itself(review):
    facts = report.comparison_facts(report.compare(review, review))
    assert facts["identical"] and facts["first_divergence"] is None
    assert all(row["difference"] in (0.0, None) for row in facts["numbers"].values())


def test_what_a_damaged_log_lacks_is_no_difference(review, folder, tmp_path):
    data = bytearray((folder / "run.mcap").read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "hurt.mcap").write_bytes(data)
    found = report.compare(review, report.review(tmp_path / "hurt.mcap"))
    assert found.first is None and not found.sound
    assert not report.comparison_facts(found)["identical"]


def test_a_message_more_in_one_of_two_whole_logs_is_where_they_part(review, tmp_path):
    longer = report.review(sample.write_run(tmp_path / "longer.mcap", end=sample.END + sample.TICK))
    first = report.compare(review, longer).first
    assert (first.time, first.topic, first.field, first.recorded) == (sample.END, "/joint_states", "", None)


def test_modes_are_paired_in_order_and_times_laid_over_each_other(review):
    spans = review.traces.spans
    skipped = [dc.replace(s, start=s.start + 10, end=s.end + 10) for s in spans if s.mode != "reach"]
    pairs = two_logs.pair_modes(spans, skipped)
    assert [b is None for _, b in pairs] == [s.mode == "reach" for s in spans]
    assert all(a.mode == b.mode for a, b in pairs if a and b)
    assert two_logs.onto(pairs, np.array([10.5, 13.25, 15.75])).tolist() == [0.5, 3.25, 5.75]


def test_the_page_of_two_runs(review, other, folder):
    page = report.comparison_page(report.compare(review, other), folder)
    check_markup(page)
    check_stands_alone(page)
    for words in (
        "2.000000 s",
        "/image_servo/servo",
        "right_error[0]",
        "simulation.valve.friction",
        "servo_final_error_m.right",
    ):
        assert words in page, words
    assert page.count('class="gantt"') == 2 and "B: right" in page and "A: right" in page


# ---------------------------------------------------------------- plots


def plot_of(time, value, **options):
    return plots.Plot(
        "t", "m", [plots.Line("a", np.asarray(time, float), np.asarray(value, float), "#000000")], **options
    )


def paths(svg):
    return re.search(r'class="line" stroke="#000000" d="([^"]*)"', svg).group(1)


def test_a_plots_line_goes_through_its_points():
    svg = plot_of([0.0, 0.1, 0.2], [0.0, 5.0, 10.0], low=0.0, height=100).svg([], 0.0, 1.0)
    y = [float(v) for v in re.findall(r"[\d.]+ ([\d.]+)", paths(svg))]
    assert y[0] == 74.0 and y[1] == pytest.approx((y[0] + y[2]) / 2, abs=0.1)


def test_a_line_is_broken_at_a_silence_and_survives_nan_and_nothing():
    assert paths(plot_of([0.0, 0.1, 2.0, 2.1], [1, 2, 3, 4]).svg([], 0.0, 3.0)).count("M") == 2
    assert paths(plot_of([0.0, 0.1, 0.2], [1, np.nan, 3]).svg([], 0.0, 1.0)).count("L") == 1
    assert paths(plot_of([], []).svg([], 0.0, 1.0)) == ""


def test_thinning_keeps_the_extremes():
    time = np.linspace(0, 60, 60 * 128)
    value = np.sin(time)
    value[3000], value[4000] = 50.0, -40.0
    t, v = plots.thin(time, value)
    assert len(t) <= 2 * plots.BUCKETS and (np.diff(t) > 0).all()
    assert v.max() == 50.0 and v.min() == -40.0


def test_ticks_are_round_and_inside():
    assert plots.nice_ticks(0.0, 10.0, 5) == [0, 2, 4, 6, 8, 10]
    assert plots.nice_ticks(-0.013, 0.021, 4) == pytest.approx([-0.01, 0.0, 0.01, 0.02])
    assert plots.nice_ticks(1.0, 1.0, 4) == [1.0]


def test_an_axis_with_a_knee_shows_small_and_large():
    svg = plot_of([0, 0.1, 0.2, 0.3], [-30.0, -0.1, 0.1, 30.0], knee=0.5, height=200).svg([], 0.0, 1.0)
    y = [float(v) for v in re.findall(r"[\d.]+ ([\d.]+)", paths(svg))]
    assert y[1] - y[2] > 5  # 0.2 of 60 would be a pixel on a linear axis
    assert ">10<" in svg and ">1<" in svg


# ---------------------------------------------------------------- a real browser

PROBE_HEAD = (
    "<script>window.faults = []; addEventListener('error', e => faults.push(e.message || 'load'), true)</script>"
)
PROBE = """<script>addEventListener('load', () => {
  const area = document.querySelector('svg.area'), box = area.getBoundingClientRect();
  const before = area.getAttribute('viewBox'), curves = 'path.line, path.dots, path.dashed, path.rings';
  const at = (kind, x) => area.dispatchEvent(new PointerEvent(kind, {clientX: x, clientY: box.top + 5, pointerId: 1}));
  at('pointermove', box.left + box.width / 10);
  const read = [...document.querySelectorAll('output')].filter(o => o.textContent).length;
  document.querySelector('.gantt .bar').dispatchEvent(new MouseEvent('click'));
  const zoomed = area.getAttribute('viewBox');
  document.getElementById('reset').click();
  document.body.insertAdjacentHTML('beforeend', '<pre id="probe">' + JSON.stringify({
    faults, read, zoomed: zoomed !== before, back: area.getAttribute('viewBox') === before,
    asked: performance.getEntriesByType('resource').map(r => r.name).filter(n => !n.startsWith('data:')),
    images: [...document.images].map(i => i.naturalWidth),
    plots: [...document.querySelectorAll('svg.plot')].map(p => p.getBoundingClientRect().height),
    drawn: [...document.querySelectorAll('svg.area')].map(a =>
      [...a.querySelectorAll(curves)].filter(p => p.getAttribute('d')).length),
    wide: document.documentElement.scrollWidth <= innerWidth}) + '</pre>');
})</script>"""


def browse(page, tmp_path):
    """-> what the probe found, and the browser's console lines. No name is resolved: nothing leaves this machine."""
    file = tmp_path / "page.html"
    file.write_text(
        page.replace("<head>", "<head>" + PROBE_HEAD, 1).replace("</body>", PROBE + "</body>"), encoding="utf-8"
    )
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    command += ["--host-resolver-rules=MAP * ~NOTFOUND", "--no-first-run", "--enable-logging=stderr"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1400,2000"]
    command += ["--virtual-time-budget=4000", "--dump-dom", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    probe = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout)
    assert probe, done.stderr[-2000:]
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(html.unescape(probe.group(1))), console


@pytest.mark.system
@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
@pytest.mark.parametrize("which", ["one", "two"])
def test_a_browser_shows_it_without_error_and_asks_for_nothing(which, page, review, other, folder, tmp_path):
    if which == "two":
        page = report.comparison_page(report.compare(review, other), folder)
    probe, console = browse(page, tmp_path)
    assert probe["faults"] == [] and console == []
    assert probe["asked"] == []
    assert len(probe["images"]) == page.count("<img") and all(width > 0 for width in probe["images"])
    assert len(probe["plots"]) == page.count('class="plot"') == 11 and all(height > 50 for height in probe["plots"])
    assert all(drawn > 0 for drawn in probe["drawn"])
    assert probe["read"] > 1  # the cursor shows values
    assert probe["zoomed"] and probe["back"] and probe["wide"]


@pytest.mark.system
@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
def test_the_browser_would_tell_of_a_request_that_leaves_the_page(page, tmp_path):
    probe, console = browse(page.replace("<body>", '<body><img src="http://example.test/a.png">', 1), tmp_path)
    assert probe["faults"] and any("example.test" in line for line in console)
