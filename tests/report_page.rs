//! The page of `ztl report` in a real browser: whatever a record says, it is laid out, and nothing of
//! it is acted on.

#![cfg(unix)]

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;
use ztl_tests::lab::{Ended, Process, Scratch, ztl};

const EVENING: &str = include_str!("../ztl-std/src/script/fixtures/evening.jsonl");
const MATINEE: &str = include_str!("../ztl-std/src/script/fixtures/matinee.jsonl");

/// What the browser has after it has loaded a page and run its scripts, as HTML.
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

/// A page that shows another in a frame, measures it, and writes down what it found.
fn measuring(page: &str) -> String {
    format!(
        r#"<!DOCTYPE html><body style="margin:0"><pre id="found"></pre>
<iframe src="{page}" style="width:1280px;height:900px;border:0"></iframe>
<script>onload = () => {{
  const page = document.querySelector('iframe').contentDocument;
  const count = (what) => page.querySelectorAll(what).length;
  for (const details of page.querySelectorAll('details')) details.open = true;
  const beyond = [...page.querySelectorAll('svg.timeline')].filter((drawing) => {{
    const frame = drawing.getBoundingClientRect();
    return [...drawing.querySelectorAll('rect')].some((bar) => {{
      const at = bar.getBoundingClientRect();
      return at.left < frame.left - 1 || at.right > frame.right + 1 || at.bottom > frame.bottom + 1;
    }});
  }});
  document.getElementById('found').textContent = JSON.stringify({{
    width: page.documentElement.scrollWidth, evil: count('x-evil'), scripts: count('script'),
    timelines: count('svg.timeline'), rows: count('table.tasks tbody tr'), beyond: beyond.length,
    height: page.documentElement.scrollHeight,
  }});
}}</script>"#
    )
}

/// What is measured of the page for these records.
#[track_caller]
fn measured(records: &[(&str, String)]) -> Value {
    let files = Scratch::new();
    let mut report = ztl();
    report.current_dir(files.path("")).arg("report");
    for (name, text) in records {
        fs::write(files.path(name), text).unwrap();
        report.arg(name);
    }
    let ended = Process::run(report.args(["-o", "page.html"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    fs::write(files.path("measure.html"), measuring("page.html")).unwrap();
    let dom = browse(&files.path("measure.html"), &files);
    let (_, found) = dom
        .split_once("<pre id=\"found\">")
        .expect("the measuring page");
    let (found, _) = found.split_once("</pre>").unwrap();
    serde_json::from_str(found).unwrap_or_else(|error| panic!("{error}: {found:?}"))
}

#[test]
fn the_page_is_laid_out_in_a_browser() {
    let records = [
        ("evening.jsonl", EVENING.to_owned()),
        ("matinee.jsonl", MATINEE.to_owned()),
    ];
    let found = measured(&records);
    assert_eq!(
        found["width"], 1280,
        "nothing is wider than the window: {found}"
    );
    // An overview for each run, and each scene that was played.
    assert_eq!(found["timelines"], 2 + 4 + 3, "{found}");
    assert_eq!(found["rows"], 14 + 11, "{found}");
    assert_eq!(
        (&found["beyond"], &found["scripts"]),
        (&0.into(), &0.into()),
        "{found}"
    );
    assert!(found["height"].as_u64() > Some(2000), "{found}");
}

#[test]
fn names_that_are_long_or_hostile_are_shown_and_harm_nothing() {
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
    let found = measured(&[("<x-evil>.jsonl", evening)]);
    assert_eq!(found["width"], 1280, "{found}");
    assert_eq!(
        (&found["evil"], &found["scripts"]),
        (&0.into(), &0.into()),
        "{found}"
    );
    assert_eq!(
        (&found["timelines"], &found["rows"]),
        (&5.into(), &14.into()),
        "{found}"
    );
    assert_eq!(found["beyond"], 0, "{found}");
}
