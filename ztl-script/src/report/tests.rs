use std::collections::BTreeMap;

use serde_json::Value;

use super::*;
use crate::record::read;

const EVENING: &str = include_str!("../fixtures/evening.jsonl");
const MATINEE: &str = include_str!("../fixtures/matinee.jsonl");

fn report(files: &[(&str, &str)]) -> Report {
    let mut records = Vec::new();
    let mut damage = Vec::new();
    for (name, text) in files {
        let (runs, found) = read(name, text.as_bytes()).unwrap();
        records.extend(runs);
        damage.extend(found);
    }
    Report::new(records, damage)
}

/// The lines of a record as they stand there, without the code that is tested.
fn lines(text: &str) -> Vec<Value> {
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect()
}

fn of<'a>(lines: &'a [Value], event: &'a str) -> impl Iterator<Item = &'a Value> {
    lines.iter().filter(move |line| line["event"] == event)
}

/// A table's rows, each by the names of its columns.
fn table(text: &str) -> Vec<BTreeMap<String, String>> {
    let mut rows: Vec<Vec<String>> = vec![vec![String::new()]];
    let mut quoted = false;
    let mut chars = text.chars().peekable();
    while let Some(char) = chars.next() {
        let cell = rows.last_mut().unwrap().last_mut().unwrap();
        match char {
            '"' if quoted && chars.peek() == Some(&'"') => cell.push(chars.next().unwrap()),
            '"' => quoted = !quoted,
            ',' if !quoted => rows.last_mut().unwrap().push(String::new()),
            '\r' if !quoted => {}
            '\n' if !quoted => rows.push(vec![String::new()]),
            other => cell.push(other),
        }
    }
    assert_eq!(rows.pop().unwrap(), [""], "the last line ends");
    let head = rows.remove(0);
    let named = |row: Vec<String>| {
        assert_eq!(row.len(), head.len(), "{row:?}");
        head.iter().cloned().zip(row).collect()
    };
    rows.into_iter().map(named).collect()
}

/// The page without the names of columns in each cell.
fn unnamed(html: &str) -> String {
    let mut pieces = html.split(" data-name=\"");
    let mut out = pieces.next().unwrap().to_owned();
    for piece in pieces {
        out += piece.split_once('"').unwrap().1;
    }
    out
}

fn millis(text: &str) -> f64 {
    text.parse::<f64>().unwrap() * 1000.0
}

#[track_caller]
fn near(one: f64, other: f64) {
    assert!((one - other).abs() < 0.6, "{one} is not {other}");
}

/// The value of an attribute in the text of an element.
fn attribute(element: &str, name: &str) -> Option<f64> {
    let (_, rest) = element.split_once(&format!(" {name}=\""))?;
    rest.split_once('"')?.0.parse().ok()
}

#[test]
fn the_task_table_matches_the_record() {
    let lines = lines(EVENING);
    let outline = &lines[0]["outline"]["scenes"];
    let rows = table(&report(&[("evening.jsonl", EVENING)]).tasks_csv());
    assert_eq!(rows.len(), of(&lines, "task_starting").count());
    for (row, start) in rows.iter().zip(of(&lines, "task_starting")) {
        let place = |name: &str| start[name].as_u64().unwrap() as usize;
        let scene = &outline[place("scene")];
        let step = &scene["steps"][place("step")];
        let task = &step["tasks"][place("part")];
        for (column, is) in [
            ("scene", &scene["name"]),
            ("step", &step["name"]),
            ("handler", &task["handler"]),
            ("component", &task["component"]),
            ("goal", &task["goal"]),
            ("remote", &task["remote"]),
        ] {
            assert_eq!(row[column], is.as_str().unwrap(), "{row:?}");
        }
        near(millis(&row["start_s"]), start["at_ms"].as_f64().unwrap());

        let states: Vec<&Value> = of(&lines, "task_state")
            .filter(|line| line["task"] == start["task"])
            .collect();
        let last = states.last().unwrap();
        assert_eq!(row["state"], last["state"].as_str().unwrap());
        assert_eq!(row["text"], last["text"].as_str().unwrap());
        let length = last["at_ms"].as_f64().unwrap() - start["at_ms"].as_f64().unwrap();
        near(millis(&row["length_s"]), length);

        let sent = of(&lines, "request_sent")
            .find(|line| line["task"] == start["task"] && line["kind"] == "INIT")
            .unwrap();
        let answer = of(&lines, "answered").find(|line| line["request"] == sent["request"]);
        let latency: f64 = row["init_latency_ms"].parse().unwrap();
        assert_eq!(latency, answer.unwrap()["latency_ms"].as_f64().unwrap());
    }
    // The arm starts half a second after the speech, by the script; the speech's INIT took 3.1 ms of that.
    assert_eq!(
        (rows[2]["component"].as_str(), rows[2]["late_s"].as_str()),
        ("arm", "0.003")
    );
    assert_eq!(rows[10]["retry_of"], "10");
    assert_eq!(
        (
            rows[10]["planned_start_s"].as_str(),
            rows[10]["late_s"].as_str()
        ),
        ("", "")
    );
    assert_eq!(
        rows[3]["awaited"], "false",
        "a step in the background awaits nothing"
    );
    // The base was unknown from the silence until the server answered again.
    near(millis(&rows[8]["unknown_s"]), 3100.0);
}

#[test]
fn the_operator_table_matches_the_record() {
    let lines = lines(EVENING);
    let rows = table(&report(&[("evening.jsonl", EVENING)]).actions_csv());
    assert_eq!(rows.len(), of(&lines, "key").count());
    for (row, key) in rows.iter().zip(of(&lines, "key")) {
        assert_eq!(row["key"], key["key"].as_str().unwrap());
        assert_eq!(
            row["command"],
            key["command"]["do"].as_str().unwrap_or_default()
        );
        near(millis(&row["at_s"]), key["at_ms"].as_f64().unwrap());
        assert_eq!(row["done"] == "true", !key["command"].is_null());
        let deviates = ["replay", "pause", "go_on", "retry", "skip", "stop"];
        assert_eq!(
            row["deviation"] == "true",
            deviates.contains(&row["command"].as_str())
        );
    }
    assert_eq!(rows[2]["after_question_s"], "1.800");
}

#[test]
fn each_task_and_step_is_drawn_at_its_time() {
    for class in ["wide", "narrow"] {
        assert_drawn_at_its_time(class);
    }
}

fn assert_drawn_at_its_time(class: &str) {
    let lines = lines(EVENING);
    let html = report(&[("evening.jsonl", EVENING)]).html();
    let mut tasks = 0;
    let mut steps = Vec::new();
    let drawings = html.split("<svg class=\"timeline ").skip(1);
    for drawing in drawings.filter(|drawing| drawing.starts_with(class)) {
        let bars: Vec<&str> = drawing.split("<rect ").skip(1).collect();
        // By the first bar that has both a time and a length, where all others must be.
        let places: Vec<(f64, f64)> = bars
            .iter()
            .filter_map(|bar| Some((attribute(bar, "data-from-ms")?, attribute(bar, "x")?)))
            .collect();
        let (from, x) = places[0];
        let scale = places
            .iter()
            .find(|(at, _)| *at > from + 1.0)
            .map(|(at, to)| (to - x) / (at - from));
        for bar in bars {
            let at = |name| attribute(bar, name);
            if let Some(number) = at("data-task") {
                let starts: Vec<&Value> = of(&lines, "task_starting")
                    .filter(|line| line["task"] == number as u64)
                    .collect();
                near(
                    at("data-from-ms").unwrap(),
                    starts[0]["at_ms"].as_f64().unwrap(),
                );
                tasks += 1;
            }
            if at("data-step").is_some() {
                steps.push((at("data-from-ms").unwrap(), at("data-to-ms").unwrap()));
            }
            // Tasks' bars begin when they were accepted.
            let Some(scale) = scale.filter(|_| at("data-task").is_none()) else {
                continue;
            };
            if let (Some(begin), Some(place)) = (at("data-from-ms"), at("x")) {
                assert!((x + (begin - from) * scale - place).abs() < 0.2, "{bar}");
            }
        }
    }
    // All in their scenes, and the one in the background in the overview too.
    assert_eq!(tasks, of(&lines, "task_starting").count() + 1);
    let expected: Vec<(f64, f64)> = of(&lines, "step_started")
        .zip(of(&lines, "step_ended"))
        .map(|(from, to)| {
            (
                from["at_ms"].as_f64().unwrap(),
                to["at_ms"].as_f64().unwrap(),
            )
        })
        .collect();
    assert_eq!(steps, expected);
}

#[test]
fn the_figures_of_a_run_match_its_record() {
    let html = report(&[("evening.jsonl", EVENING)]).html();
    let lines = lines(EVENING);
    let last = lines.last().unwrap()["at_ms"].as_f64().unwrap();
    for (name, value) in [
        ("length (s)", format!("{:.3}", last / 1000.0)),
        ("outcome", "stopped".to_owned()),
        (
            "scenes played",
            of(&lines, "scene_started").count().to_string(),
        ),
        ("scenes skipped", "1".to_owned()),
        ("steps", of(&lines, "step_started").count().to_string()),
        ("tasks", of(&lines, "task_starting").count().to_string()),
        ("completed", "9".to_owned()),
        ("failed", "2".to_owned()),
        ("aborted", "3".to_owned()),
        ("unknown", "0".to_owned()),
        ("deviations", "6".to_owned()),
        // Six questions about scenes, as the generator of the fixture waited.
        ("waits for the operator (s)", "7.300".to_owned()),
        ("pauses (s)", "2.500".to_owned()),
        // A refusal, a silent server, a failure.
        ("waits for a server or a decision (s)", "6.900".to_owned()),
    ] {
        let figure = format!("<dt>{name}</dt><dd>{value}</dd>");
        assert!(html.contains(&figure), "{figure}");
    }
}

#[test]
fn the_planned_length_of_a_step_adds_delays_and_task_durations() {
    let html = report(&[("matinee.jsonl", MATINEE)]).html();
    let html = unnamed(&html);
    // Turn: 0.5 s, then the base; 1 s later the arm, which takes as long as its server says.
    let lines = lines(MATINEE);
    let at = |event: &str, pick: &dyn Fn(&Value) -> bool| {
        of(&lines, event).find(|line| pick(line)).unwrap()["at_ms"]
            .as_f64()
            .unwrap()
    };
    let step = |line: &Value| line["scene"] == 1 && line["step"] == 0;
    let arm = of(&lines, "task_starting")
        .find(|line| step(line) && line["part"] == 1)
        .unwrap();
    let state =
        |is: &'static str| move |line: &Value| line["task"] == arm["task"] && line["state"] == is;
    let own = at("task_state", &state("completed")) - at("task_state", &state("accepted"));
    let (from, to) = (at("step_started", &step), at("step_ended", &step));
    let planned = 1500.0 + own;
    let cells = format!(
        "<td class=\"n\">{:.3}</td><td class=\"n\">{:.3}</td><td class=\"n\">+{:.3}</td>",
        planned / 1000.0,
        (to - from) / 1000.0,
        (to - from - planned) / 1000.0
    );
    assert!(html.contains(&cells), "{cells}");
}

#[test]
fn a_step_left_early_has_no_planned_length() {
    let html = report(&[("evening.jsonl", EVENING)]).html();
    let (_, stopped) = html.split_once("<h3>4. Goodbye</h3>").unwrap();
    let (note, drawing) = stopped.split_once("</p>").unwrap();
    assert!(
        note.contains("stopped; from") && !note.contains("planned"),
        "{note}"
    );
    let (drawing, _) = drawing.split_once("</section>").unwrap();
    assert!(drawing.contains("data-step") && !drawing.contains("data-plan"));
}

#[test]
fn several_runs_are_compared_by_step() {
    let html = report(&[("evening.jsonl", EVENING), ("matinee.jsonl", MATINEE)]).html();
    let html = unnamed(&html);
    assert!(html.contains("<a href=\"#run-2\">matinee.jsonl</a>"));
    let mut lengths = Vec::new();
    for text in [EVENING, MATINEE] {
        let lines = lines(text);
        let mine = |line: &&Value| line["scene"] == 0 && line["step"] == 1;
        let starts = of(&lines, "step_started").filter(mine);
        let ends = of(&lines, "step_ended").filter(mine);
        let at = |line: &Value| line["at_ms"].as_f64().unwrap();
        lengths.extend(starts.zip(ends).map(|(from, to)| at(to) - at(from)));
    }
    lengths.sort_by(f64::total_cmp);
    assert_eq!(
        lengths.len(),
        3,
        "twice in the evening, once in the matinee"
    );
    let [least, median, most] = [0, 1, 2].map(|at: usize| format!("{:.3}", lengths[at] / 1000.0));
    let row = html
        .split("<tr>")
        .find(|row| row.contains("<td class=\"long\">greet</td>"))
        .unwrap();
    let cells: Vec<&str> = row
        .split("<td class=\"n\">")
        .skip(1)
        .map(|c| c.split('<').next().unwrap())
        .collect();
    assert_eq!(
        (cells[0], &cells[2..5]),
        ("3", &[&*median, &*least, &*most][..])
    );
}

#[test]
fn the_page_warns_about_runs_of_different_scripts() {
    let other = MATINEE.replacen("5891b5b5", "00000000", 1);
    let html = report(&[("a", EVENING), ("b", &other)]).html();
    assert!(html.contains("These are runs of 2 different scripts"));
    assert!(
        !report(&[("a", EVENING), ("b", MATINEE)])
            .html()
            .contains("different scripts")
    );
}

#[test]
fn a_run_counts_as_stopped_only_if_nothing_may_still_run() {
    let ended = r#""outcome":"stopped","running":[]"#;
    assert!(EVENING.contains(ended));
    for (written, told) in [
        (ended, "stopped"),
        // As older versions wrote it.
        (
            r#""outcome":"stopped","running":[1,2]"#,
            "stopping not confirmed",
        ),
        (
            r#""outcome":"not_confirmed","running":[1]"#,
            "stopping not confirmed",
        ),
    ] {
        let html = report(&[("evening.jsonl", &EVENING.replace(ended, written))]).html();
        let figure = format!("<dt>outcome</dt><dd>{told}</dd>");
        assert!(html.contains(&figure), "{figure} of {written}");
    }
}

#[test]
fn text_of_a_record_is_escaped() {
    fn poison(value: &mut Value) {
        match value {
            Value::String(text) => text.push_str("\"'><x-evil a=\"'&\u{0}"),
            Value::Array(all) => all.iter_mut().for_each(poison),
            Value::Object(all) => {
                // What the schema fixes stays; all that is free text is poisoned.
                let fixed = [
                    "event", "wall", "do", "about", "is", "state", "by", "end", "kind", "because",
                    "outcome",
                ];
                let free = all
                    .iter_mut()
                    .filter(|(key, value)| !fixed.contains(&key.as_str()) || value.is_object());
                free.for_each(|(_, value)| poison(value));
            }
            _ => {}
        }
    }
    let mut lines = lines(EVENING);
    let note = r#"{"at_ms":1,"wall":"2025-11-21T16:00:00Z","event":"note","text":"n"}"#;
    lines.insert(
        1,
        serde_json::from_str(&note.replace(":1,", ":0,")).unwrap(),
    );
    lines.iter_mut().for_each(poison);
    let text: Vec<String> = lines.iter().map(ToString::to_string).collect();
    let broken = format!("{}\n{{\"<x-evil>\"", text.join("\n"));
    let html = report(&[("<x-evil>.jsonl", &broken)]).html();
    assert!(html.contains("&lt;x-evil a="), "it is shown");
    assert!(!html.contains("<x-evil"), "and not acted on");
    assert!(!html.contains("\"'>"));
    assert!(!html.contains('\u{0}'));
}

#[test]
fn the_page_loads_no_external_resources() {
    let html = report(&[("evening.jsonl", EVENING), ("matinee.jsonl", MATINEE)]).html();
    for loads in [
        "src=", "<link", "<script", "@import", "http://", "https://", "<iframe", "<object",
    ] {
        assert!(!html.contains(loads), "{loads}");
    }
    assert!(html.replace("url(#", "").find("url(").is_none());
}

#[test]
fn a_damaged_record_is_reported_as_far_as_possible_with_a_warning() {
    for cut in (0..EVENING.len())
        .step_by(499)
        .filter(|cut| EVENING.is_char_boundary(*cut))
    {
        let report = report(&[("cut.jsonl", &EVENING[..cut])]);
        let html = report.html();
        assert!(html.contains("The records are damaged"), "cut at {cut}");
        table(&report.tasks_csv());
        table(&report.actions_csv());
    }
    let cut = EVENING.lines().take(100).collect::<Vec<_>>().join("\n");
    let html = report(&[("cut.jsonl", &cut)]).html();
    assert!(html.contains("cut.jsonl:100: the end of cut.jsonl is lacking"));
    assert!(html.contains("no end in the record"));
}

#[test]
fn a_page_is_rendered_with_any_line_missing() {
    let all: Vec<&str> = EVENING.lines().collect();
    for lacking in 1..all.len() {
        let mut some = all.clone();
        some.remove(lacking);
        let report = report(&[("run.jsonl", &some.join("\n"))]);
        assert!(report.html().ends_with("</html>\n"));
        table(&report.tasks_csv());
    }
    // An outline that says nothing: everything is called by its number.
    let (_, rest) = EVENING.split_once("\"outline\":").unwrap();
    let end = rest.find("]}]}]}}").unwrap() + "]}]}]}".len();
    let bare = EVENING.replacen(&rest[..end], "{\"scenes\":[]}", 1);
    let html = report(&[("run.jsonl", &bare)]).html();
    assert!(html.contains("scene 2 / step 1"), "{html}");
}

#[test]
fn failed_tasks_are_at_the_top_with_their_reasons() {
    let html = report(&[("evening.jsonl", EVENING)]).html();
    let (top, rest) = html.split_once("<section class=\"run\"").unwrap();
    for words in [
        "2 tasks failed or unknown",
        "<b>rejected</b>: busy: &#39;ring&#39; is in use; it takes one task at a time",
        "<b>failed</b>: ",
    ] {
        assert!(top.contains(words), "{words} in {top}");
    }
    assert!(!top.contains("<b>aborted</b>"), "{top}");
    assert!(rest.contains("<table class=\"tasks\">"));
    let well = EVENING.replace("\"state\":\"refused\"", "\"state\":\"completed\"");
    let well = well.replace("\"state\":\"failed\"", "\"state\":\"completed\"");
    let html = report(&[("evening.jsonl", &well)]).html();
    assert!(html.contains("No task failed or is unknown."));
    // Of several runs, whose it was.
    let html = report(&[("evening.jsonl", EVENING), ("matinee.jsonl", MATINEE)]).html();
    assert!(html.contains("evening.jsonl, Welcome"), "{html}");
}

#[test]
fn a_stop_that_was_not_confirmed_is_named_at_the_top() {
    let top = |text: &str| {
        let html = report(&[("evening.jsonl", text)]).html();
        let (top, _) = html.split_once("<section class=\"run\"").unwrap();
        top.to_owned()
    };
    assert!(!top(EVENING).contains("stop not confirmed"));
    let answered = r#""task":13,"confirmed":true,"text":"aborted""#;
    assert!(EVENING.contains(answered));
    let ended = r#""event":"task_state","task":13,"state":"aborted""#;
    assert!(EVENING.contains(ended));
    let running = EVENING.replace(ended, r#""event":"task_state","task":13,"state":"unknown""#);
    // Refused, and never answered.
    for (told, why) in [
        (
            r#""task":13,"confirmed":false,"text":"it cannot be stopped""#,
            "it cannot be stopped",
        ),
        (
            r#""task":99,"confirmed":true,"text":"""#,
            "no answer in the record",
        ),
    ] {
        let top = top(&running.replace(answered, told));
        let named = format!("<b>stop not confirmed</b>: {why} <small><code>robot:arm:wave</code>");
        for words in ["2 tasks failed or unknown, 1 stop not confirmed", &named] {
            assert!(top.contains(words), "{words} in {top}");
        }
    }
    // It ended after the run gave up stopping it.
    let late = EVENING.replace(answered, r#""task":13,"confirmed":false,"text":"""#);
    let (before, told) = late.split_once(r#"{"at_ms":31714.3"#).unwrap();
    let state = r#"{"at_ms":31714.2,"wall":"2025-11-21T16:00:31Z","event":"task_state","task":13,"state":"aborted","text":""}"#;
    let late = format!("{before}{state}\n{{\"at_ms\":31714.3{told}");
    assert!(!top(&late).contains("stop not confirmed"));
    // Tasks of others: one is found and goes on, and a server does not list its tasks.
    let stamp = r#"{"at_ms":31714.2,"wall":"2025-11-21T16:00:31Z","event":"#;
    let events = [
        r#""stopping","tasks":[],"remotes":["robot","light"]}"#,
        r#""task_found","task":50,"remote":"robot","id":7,"text":"robot:arm:up"}"#,
        r#""tasks_listed","remote":"robot","gaps":[]}"#,
        r#""tasks_listed","remote":"light","gaps":["no answer for 2.0 s"]}"#,
    ];
    let events: String = events
        .iter()
        .map(|event| format!("{stamp}{event}\n"))
        .collect();
    let top = top(&EVENING.replace(
        r#"{"at_ms":31714.3"#,
        &format!("{events}{{\"at_ms\":31714.3"),
    ));
    for words in [
        "2 stops not confirmed",
        "<code>robot:arm:up</code>",
        "no answer for 2.0 s <small><code>tasks of others on &#39;light&#39;</code>",
    ] {
        assert!(top.contains(words), "{words} in {top}");
    }
}
