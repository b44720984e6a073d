//! The HTML page of a report.

use std::collections::BTreeMap;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::html::Table;
use super::run::{PlayedTask, ReportedRun, WaitCause};
use super::{failures, svg, tables, words};
use crate::drawing::{PATTERNS, STYLE, escape};
use crate::durations::{difference, median, seconds, spoken};
use crate::event::{Ending, TaskState};
use crate::record::Damage;

pub(super) fn page(runs: &[ReportedRun], damage: &[Damage]) -> String {
    let title = match runs {
        [] => "No run".to_owned(),
        [run] => format!("{}, {}", run.record.started.script, started_at(run)),
        runs => format!("{} runs", runs.len()),
    };
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width\">\n\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n\
         <title>{}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n{}<main>\n",
        escape(&title),
        PATTERNS
    );
    out += &format!("<h1>{}</h1>\n", escape(&title));
    out += &damage_list(damage);
    if !runs.is_empty() {
        out += &failures::section(runs);
    }
    if runs.len() > 1 {
        out += &comparison(runs);
        out += &medians(runs);
    }
    if !runs.is_empty() {
        out += LEGEND;
    }
    for (nth, run) in runs.iter().enumerate() {
        out += &one(run, nth, runs.len());
    }
    out += &format!(
        "<footer>Made by ztl {} from {}. Times are in seconds from the start of the run.</footer>\n</main>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION"),
        match runs.len() {
            1 => "one record".to_owned(),
            runs => format!("the records of {runs} runs"),
        }
    );
    out
}

const LEGEND: &str = "<p class=\"legend\">\
<span><i class=\"k plan\"></i>as planned</span><span><i class=\"k actual\"></i>as it was</span>\
<span><i class=\"k completed\"></i>completed ✓</span><span><i class=\"k failed\"></i>failed, rejected or not started ✗</span>\
<span><i class=\"k aborted\"></i>aborted ■</span><span><i class=\"k unknown\"></i>unknown ?</span>\
<span><i class=\"k open\"></i>goes on ›</span><span><i class=\"k wait-o\"></i>wait for the operator</span>\
<span><i class=\"k wait-t\"></i>wait for a server or a decision</span><span><i class=\"k mark\"></i>deviation by the operator</span></p>\n";

fn damage_list(damage: &[Damage]) -> String {
    if damage.is_empty() {
        return String::new();
    }
    let lines = damage
        .iter()
        .map(|damage| format!("<li>{}</li>", escape(&damage.to_string())));
    let lines: String = lines.collect();
    format!(
        "<div class=\"damage\"><p>The records are damaged. This report tells what could be read.</p><ul>{lines}</ul></div>\n"
    )
}

/// When the run started, by the wall clock: `2026-01-01 00:00:00 UTC`.
fn started_at(run: &ReportedRun) -> String {
    let first = run.record.events.first();
    let at = first.map_or(UNIX_EPOCH, |event| event.wall).max(UNIX_EPOCH);
    // Later times have no RFC 3339 form.
    let most = UNIX_EPOCH + Duration::from_secs(253_402_300_799);
    let text = humantime::format_rfc3339_seconds(SystemTime::min(at, most)).to_string();
    text.replace('T', " ").replace('Z', " UTC")
}

/// The figures of a run, in the order shown.
fn figures(run: &ReportedRun) -> Vec<(&'static str, String)> {
    let count =
        |of: fn(&PlayedTask) -> bool| run.tasks.iter().filter(|task| of(task)).count().to_string();
    let steps: usize = run.takes.iter().map(|take| take.steps.len()).sum();
    vec![
        ("length (s)", seconds(run.length)),
        ("outcome", words::outcome(run.outcome).to_owned()),
        ("scenes played", run.takes.len().to_string()),
        ("scenes skipped", run.skipped.len().to_string()),
        ("steps", steps.to_string()),
        ("tasks", run.tasks.len().to_string()),
        (
            "completed",
            count(|task| task.state == TaskState::Completed),
        ),
        (
            "failed",
            count(|task| task.state.is_failure() && task.state != TaskState::Aborted),
        ),
        ("aborted", count(|task| task.state == TaskState::Aborted)),
        ("unknown", count(|task| task.state == TaskState::Unknown)),
        ("deviations", run.deviations().count().to_string()),
        (
            "waits for the operator (s)",
            seconds(run.waited(|cause| *cause == WaitCause::Operator)),
        ),
        (
            "pauses (s)",
            seconds(run.waited(|cause| *cause == WaitCause::Pause)),
        ),
        (
            "waits for a server or a decision (s)",
            seconds(run.waited(|cause| matches!(cause, WaitCause::Unsettled(_)))),
        ),
    ]
}

fn comparison(runs: &[ReportedRun]) -> String {
    let mut out = "<section><h2>Runs compared</h2>\n".to_owned();
    let scripts: BTreeMap<&str, &str> = runs
        .iter()
        .map(|run| {
            (
                run.record.started.sha256.as_str(),
                run.record.started.script.as_str(),
            )
        })
        .collect();
    if scripts.len() > 1 {
        out += &format!(
            "<p class=\"note\">These are runs of {} different scripts (by their SHA-256).</p>\n",
            scripts.len()
        );
    }
    let mut columns = vec!["~run", "start"];
    let numbers: Vec<String> = runs
        .first()
        .map(figures)
        .unwrap_or_default()
        .into_iter()
        .map(|(name, _)| {
            if name == "outcome" {
                name.to_owned()
            } else {
                format!("#{name}")
            }
        })
        .collect();
    columns.extend(numbers.iter().map(String::as_str));
    let mut table = Table::new("runs", &columns);
    for (nth, run) in runs.iter().enumerate() {
        let mut cells = vec![
            format!(
                "<a href=\"#run-{}\">{}</a>",
                nth + 1,
                escape(&run.record.name)
            ),
            escape(&started_at(run)),
        ];
        cells.extend(figures(run).into_iter().map(|(_, value)| escape(&value)));
        table.row("", &cells);
    }
    out + &table.end() + "</section>\n"
}

/// A step in all runs.
#[derive(Default)]
struct OfStep {
    planned: Vec<Duration>,
    actual: Vec<Duration>,
    failures: usize,
    unsettled: Duration,
}

fn medians(runs: &[ReportedRun]) -> String {
    // Steps are matched by their names, since the scripts may differ. Order: first occurrence.
    let mut order: Vec<(String, String)> = Vec::new();
    let mut steps: BTreeMap<(String, String), OfStep> = BTreeMap::new();
    for run in runs {
        for scene in 0..run.outline().scenes.len() {
            let count = run.scene(scene).map_or(0, |scene| scene.steps.len());
            for step in 0..count {
                let key = (run.scene_name(scene), run.step_name(scene, step));
                if !order.contains(&key) {
                    order.push(key);
                }
            }
        }
        for take in &run.takes {
            for step in &take.steps {
                let key = (
                    run.scene_name(take.scene),
                    run.step_name(take.scene, step.step),
                );
                let of = steps.entry(key).or_default();
                // A step that was left early says nothing about its duration.
                if matches!(step.end, Some(Ending::Completed | Ending::Failures)) {
                    of.planned.extend(step.planned);
                    of.actual.push(step.length());
                }
                of.failures += usize::from(step.end == Some(Ending::Failures));
                let mine = run.waits.iter().filter(|wait| {
                    matches!(wait.cause, WaitCause::Unsettled(_))
                        && wait.from >= step.from
                        && wait.from <= step.to
                });
                of.unsettled += mine
                    .map(|wait| wait.to.saturating_sub(wait.from))
                    .sum::<Duration>();
            }
        }
    }
    let longest = steps
        .values()
        .flat_map(|of| &of.actual)
        .max()
        .copied()
        .unwrap_or_default();
    let mut table = Table::new(
        "steps",
        &[
            "~scene",
            "~step",
            "#times",
            "#planned, median (s)",
            "#actual, median (s)",
            "#least (s)",
            "#most (s)",
            "#with failures",
            "#waits for a server or a decision (s)",
            "each time",
        ],
    );
    for key in order {
        let none = OfStep::default();
        let of = steps.get(&key).unwrap_or(&none);
        let time = |time: Option<Duration>| time.map_or("–".to_owned(), seconds);
        table.row(
            "",
            &[
                escape(&key.0),
                escape(&key.1),
                of.actual.len().to_string(),
                time(median(&of.planned)),
                time(median(&of.actual)),
                time(of.actual.iter().min().copied()),
                time(of.actual.iter().max().copied()),
                of.failures.to_string(),
                seconds(of.unsettled),
                strip(&of.actual, longest),
            ],
        );
    }
    let head = "<section><h2>Steps of all runs</h2>\n<p class=\"note\">Each time that a step was played to its end counts, replays too.</p>\n";
    format!("{head}{}</section>\n", table.end())
}

/// A dot for each value on a common scale.
fn strip(values: &[Duration], longest: Duration) -> String {
    let longest = longest.as_secs_f64().max(0.001);
    let dots = values.iter().map(|value| {
        let x = 4.0 + value.as_secs_f64() / longest * 152.0;
        format!("<circle class=\"each\" cx=\"{x:.1}\" cy=\"7\" r=\"3\"/>")
    });
    let dots: String = dots.collect();
    format!(
        "<svg class=\"strip\" viewBox=\"0 0 160 14\" width=\"160\" height=\"14\" aria-hidden=\"true\"><line class=\"grid\" x1=\"4\" y1=\"7\" x2=\"156\" y2=\"7\"/>{dots}</svg>"
    )
}

fn one(run: &ReportedRun, nth: usize, of: usize) -> String {
    let mut out = format!("<section class=\"run\" id=\"run-{}\">\n", nth + 1);
    if of > 1 {
        out += &format!("<h2>{}</h2>\n", escape(&run.record.name));
    }
    out += &facts(run);
    out += &svg::overview(run);
    out += &run.drawing;
    let body = scenes(run) + &tables::all(run);
    if of > 1 {
        out += &format!(
            "<details><summary>Scenes, tasks and what the operator did (printed when open)</summary>\n{body}</details>\n"
        );
    } else {
        out += &body;
    }
    out + "</section>\n"
}

fn facts(run: &ReportedRun) -> String {
    let started = &run.record.started;
    let versions = started
        .versions
        .iter()
        .map(|(name, version)| format!("{name} {version}"));
    let versions: Vec<String> = versions.collect();
    let remotes = started.remotes.iter().map(|remote| match &remote.endpoint {
        Some(endpoint) => format!("{} = {endpoint} {}", remote.name, remote.scope),
        None => format!("{} = not configured", remote.name),
    });
    let remotes: Vec<String> = remotes.collect();
    let mut out = "<dl class=\"facts\">".to_owned();
    let mut fact = |name: &str, value: &str| {
        if !value.is_empty() {
            out += &format!(
                "<div><dt>{}</dt><dd>{}</dd></div>",
                escape(name),
                escape(value)
            );
        }
    };
    fact("record", &run.record.name);
    fact("script", &started.script);
    fact("SHA-256", &started.sha256);
    fact("start", &started_at(run));
    fact("options", &started.options.join(" "));
    fact("versions", &versions.join(", "));
    fact("servers", &remotes.join("; "));
    fact(
        "configuration",
        started.config.as_deref().unwrap_or_default(),
    );
    fact("said at the end", &run.last_words);
    out += "</dl>\n<dl class=\"figures\">";
    for (name, value) in figures(run) {
        out += &format!(
            "<div><dt>{}</dt><dd>{}</dd></div>",
            escape(name),
            escape(&value)
        );
    }
    out + "</dl>\n"
}

fn scenes(run: &ReportedRun) -> String {
    let mut out = String::new();
    for (nth, take) in run.takes.iter().enumerate() {
        let replay = if take.replay { ", replayed" } else { "" };
        let length = take.length();
        let planned = take.planned(run).map(|planned| {
            format!(
                ", planned {} ({} s)",
                spoken(planned),
                difference(length, planned)
            )
        });
        out += &format!(
            "<section class=\"scene\"><h3>{}. {}</h3>\n<p class=\"note\">{}{replay}; from {} s, {} long{}</p>\n",
            take.scene + 1,
            escape(&svg::take_name(run, take)),
            words::ending(take.end),
            seconds(take.from),
            spoken(length),
            planned.unwrap_or_default(),
        );
        if take.steps.is_empty() {
            out += "<p class=\"note\">No step was started.</p>\n";
        } else {
            out += &svg::take(run, nth, take);
        }
        out += "</section>\n";
    }
    out
}
