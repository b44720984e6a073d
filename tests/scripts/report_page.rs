//! The page of `ztl report` in a real browser: it shows any text of a record and executes none of it.

use std::fs;
use std::path::Path;
use std::process::Command;

use std::time::{Duration, Instant, SystemTime};

use serde_json::Value;
use ztl_pickle::Pickle;
use ztl_record::{Formats, Message, Recording, SoundFormat, Source};
use ztl_tests::lab::{Ended, Process, Scratch, ztl};

const EVENING: &str = include_str!("../../ztl-script/src/fixtures/evening.jsonl");
const MATINEE: &str = include_str!("../../ztl-script/src/fixtures/matinee.jsonl");

/// The HTML of a browser's document after it has loaded a page and run its scripts.
#[track_caller]
fn browse(page: &Path, files: &Scratch) -> String {
    let mut chromium = Command::new("chromium");
    chromium
        .args([
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
        ])
        .args(["--window-size=1280,900", "--allow-file-access-from-files"])
        .args(["--virtual-time-budget=5000", "--dump-dom"])
        .arg(format!(
            "--user-data-dir={}",
            files.path("browser").display()
        ))
        .arg(format!("file://{}", page.display()));
    let Ended {
        code,
        stdout,
        stderr,
    } = Process::run(&mut chromium);
    assert_eq!(code, Some(0), "{stderr}");
    stdout
}

/// The window widths of a phone, a tablet and a desktop.
const WIDTHS: [u64; 3] = [390, 820, 1440];

/// A page that shows another in a frame of each width, measures it, and prints the result.
fn measuring(page: &str) -> String {
    format!(
        r#"<!DOCTYPE html><body style="margin:0"><pre id="found"></pre>
<iframe src="{page}" style="height:900px;border:0"></iframe>
<script>onload = () => {{
  const frame = document.querySelector('iframe');
  const page = frame.contentDocument;
  const all = (what) => [...page.querySelectorAll(what)];
  const place = (it) => it.getBoundingClientRect();
  const seen = (it) => place(it).width > 0;
  const measure = (width) => {{
    frame.style.width = width + 'px';
    for (const details of all('details')) details.open = true;
    const timelines = all('svg.timeline').filter(seen);
    const beyond = timelines.filter((drawing) => {{
      const frame = place(drawing);
      return [...drawing.querySelectorAll('rect, text')].some((part) => {{
        const at = place(part);
        // The name of a bar is cut by the box around it.
        const cut = part.parentNode.closest('svg') !== drawing;
        // The last number of a scale may use the margin of the page.
        const [left, right] = part.matches('text') ? [0, width] : [frame.left - 1, frame.right + 1];
        return !cut && (at.left < left || at.right > right || at.bottom > frame.bottom + 1);
      }});
    }});
    const scale = (drawing) => place(drawing).width / drawing.viewBox.baseVal.width;
    const outside = (it) => place(it).left < 0 || place(it).right > width + 0.5;
    const clipped = all('.scroll').filter((it) => it.scrollWidth > it.clientWidth + 1);
    return {{
      width: page.documentElement.scrollWidth, height: page.documentElement.scrollHeight,
      evil: all('x-evil').length, scripts: all('script').length,
      timelines: timelines.length, beyond: beyond.length, scale: Math.min(...timelines.map(scale)),
      rows: all('table.tasks tbody tr').length, clipped: clipped.length,
      outside: all('table, td, dl, li, h1, h2, h3').filter(outside).length,
      failures: place(page.querySelector('.failures')).top, first: place(timelines[0]).top,
    }};
  }};
  document.getElementById('found').textContent = JSON.stringify({WIDTHS:?}.map(measure));
}}</script>"#
    )
}

/// The measurements of the page for these records.
#[track_caller]
fn measured(records: &[(&str, String)]) -> Vec<(u64, Value)> {
    let files = Scratch::new();
    for (name, text) in records {
        fs::write(files.path(name), text).unwrap();
    }
    let names: Vec<&str> = records.iter().map(|(name, _)| *name).collect();
    measured_files(&files, &names)
}

/// The measurements of the page for the records in these files.
#[track_caller]
fn measured_files(files: &Scratch, names: &[&str]) -> Vec<(u64, Value)> {
    let mut report = ztl();
    report.current_dir(files.path("")).arg("report").args(names);
    let ended = Process::run(report.args(["-o", "page.html"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    fs::write(files.path("measure.html"), measuring("page.html")).unwrap();
    let dom = browse(&files.path("measure.html"), files);
    let (_, found) = dom
        .split_once("<pre id=\"found\">")
        .expect("the measuring page");
    let (found, _) = found.split_once("</pre>").unwrap();
    let found: Vec<Value> =
        serde_json::from_str(found).unwrap_or_else(|error| panic!("{error}: {found:?}"));
    WIDTHS.into_iter().zip(found).collect()
}

/// The whole page fits a window of this width and is large enough to read.
#[track_caller]
fn fits(width: u64, found: &Value) {
    assert_eq!(found["width"], width, "{found}");
    for none in ["beyond", "clipped", "outside", "evil", "scripts"] {
        assert_eq!(found[none], 0, "{none} at {width}: {found}");
    }
    // Letters have 11 units and more.
    assert!(found["scale"].as_f64() >= Some(0.8), "{width}: {found}");
    assert!(
        found["failures"].as_f64() < found["first"].as_f64(),
        "what failed is on top: {found}"
    );
}

#[test]
fn the_page_is_laid_out_in_a_browser() {
    let records = [
        ("evening.jsonl", EVENING.to_owned()),
        ("matinee.jsonl", MATINEE.to_owned()),
    ];
    for (width, found) in measured(&records) {
        fits(width, &found);
        // An overview for each run, and each scene that was played.
        assert_eq!(found["timelines"], 2 + 4 + 3, "{found}");
        assert_eq!(found["rows"], 14 + 11, "{found}");
        assert!(found["height"].as_u64() > Some(2000), "{found}");
    }
}

/// A recording of the run in a record, with streams of all kinds beside it, whose names are hostile.
fn recording(path: &Path) {
    let topic = |name: &str| format!("/<x-evil>{}/{name}", "W".repeat(100));
    let mut formats = Formats::default();
    let (rate, channels) = (800, 1);
    formats.set_sound(&topic("sound"), SoundFormat { rate, channels });
    let mut recording = Recording::create(path).unwrap();
    let start = Instant::now();
    let source = Source::named("sensors");
    for line in EVENING.lines() {
        let event: Value = serde_json::from_str(line).unwrap();
        let at = start + Duration::from_secs_f64(event["at_ms"].as_f64().unwrap() / 1e3);
        let message = Message::of_run(line.as_bytes().to_vec(), SystemTime::now());
        recording.write(&source, message, at).unwrap();
        let number = (at - start).as_secs_f64().sin();
        let fields = ["x", "y", "<x-evil>", &"W".repeat(100)]
            .map(|name| (Pickle::text(name).unwrap(), number));
        let values = [
            ("number", number.into()),
            ("numbers", Pickle::dict(fields).unwrap()),
            (
                "image",
                Pickle::bytes(b"\xff\xd8\xff\xe0 no image").unwrap(),
            ),
            ("sound", Pickle::bytes(&[7; 80]).unwrap()),
            ("text", Pickle::text("<script>alert(1)</script>").unwrap()),
        ];
        for (name, value) in values {
            let message = formats.prepare(&source, &topic(name), &value.to_bytes());
            recording.write(&source, message.unwrap(), at).unwrap();
        }
    }
    recording.finish().unwrap();
}

#[test]
fn the_page_of_a_recorded_run_is_laid_out_in_a_browser() {
    let files = Scratch::new();
    recording(&files.path("evening.mcap"));
    for (width, found) in measured_files(&files, &["evening.mcap"]) {
        fits(width, &found);
        // The run's, and that of its streams.
        assert_eq!(found["timelines"], 1 + 4 + 1, "{found}");
        assert_eq!(found["rows"], 14, "{found}");
    }
    // Compared with a record.
    fs::write(files.path("matinee.jsonl"), MATINEE).unwrap();
    for (width, found) in measured_files(&files, &["evening.mcap", "matinee.jsonl"]) {
        fits(width, &found);
        assert_eq!(found["timelines"], 2 + 4 + 3 + 1, "{found}");
    }
}

#[test]
fn long_or_hostile_names_are_shown_safely() {
    let name = format!(
        "\\\"'></title><x-evil onclick='1'><script>alert(1)</script>{}",
        "W".repeat(300)
    );
    let texts = [
        "look up",
        "greet",
        "Welcome",
        "Dance",
        "wave",
        "done",
        "joint 3: over-current",
    ];
    let evening = texts.iter().fold(EVENING.to_owned(), |text, old| {
        text.replace(&format!(":\"{old}\""), &format!(":\"{name}\""))
    });
    for (width, found) in measured(&[("<x-evil>.jsonl", evening)]) {
        fits(width, &found);
        assert_eq!(
            (&found["timelines"], &found["rows"]),
            (&5.into(), &14.into()),
            "{found}"
        );
    }
}
