//! `ztl run-script --record` writes what `docs/record.md` describes, and a record is readable after a crash.

use std::fs;

use serde_json::Value;
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, until, ztl};

const DOCS: &str = include_str!("../../docs/record.md");

/// The first block of the documentation in this language.
#[track_caller]
fn block(language: &str) -> &'static str {
    let (_, rest) = DOCS
        .split_once(&format!("```{language}\n"))
        .expect(language);
    rest.split_once("```").expect("its end").0
}

/// A record as values, without the parts that differ between runs.
fn lasting(lines: &str) -> Vec<Value> {
    fn settle(value: &mut Value) {
        match value {
            Value::Object(fields) => {
                for (name, value) in fields {
                    match (name.as_str(), &*value) {
                        ("at_ms" | "latency_ms" | "id", Value::Number(_)) => *value = 0.into(),
                        ("wall" | "sha256" | "endpoint" | "versions" | "text", _) => {
                            settle_text(value)
                        }
                        _ => settle(value),
                    }
                }
            }
            Value::Array(all) => all.iter_mut().for_each(settle),
            _ => {}
        }
    }
    /// Numbers of several digits, and all of a hash.
    fn settle_text(value: &mut Value) {
        match value {
            Value::String(text) if text.len() == 64 => "hash".clone_into(text),
            Value::String(text) => *text = text.replace(|char: char| char.is_ascii_digit(), ""),
            // The programs without their versions.
            Value::Array(versions) => versions
                .iter_mut()
                .for_each(|version| version[1] = Value::Null),
            _ => {}
        }
    }
    let values = lines.lines().map(|line| {
        let mut value =
            serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"));
        settle(&mut value);
        value
    });
    values.collect()
}

/// A server, and a script and its configuration in a directory.
fn stage(script: &str) -> (Server, Scratch) {
    let server = Server::ours();
    let files = Scratch::new();
    fs::write(files.path("one.yaml"), script).unwrap();
    let port = server.port;
    let remotes = format!("remotes: {{test: {{host: 127.0.0.1, port: {port}, scope: /test}}}}\n");
    fs::write(files.path("remotes.yaml"), remotes).unwrap();
    (server, files)
}

const PLAY: &str = "run-script -s one.yaml -c remotes.yaml --yes --record one.jsonl";

#[test]
fn the_documented_record_matches_a_written_one() {
    let (_server, files) = stage(block("yaml"));
    assert!(DOCS.contains(&format!("`ztl {PLAY}`")));
    let ended = Process::run(ztl().current_dir(files.path("")).args(PLAY.split(' ')));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let written = lasting(&fs::read_to_string(files.path("one.jsonl")).unwrap());
    // Joins lines that were wrapped for reading.
    let told = lasting(&block("json").replace("\n    ", ""));
    for (written, told) in written.iter().zip(&told) {
        assert_eq!(written, told);
    }
    assert_eq!(written.len(), told.len());
    for line in &written {
        let event = line["event"].as_str().unwrap();
        assert!(DOCS.contains(&format!("`{event}`")), "{event} is explained");
    }
}

#[test]
fn a_record_is_readable_up_to_a_crash() {
    let (_server, files) =
        stage("one:\n  first: {test: {echo: hello}}\n  second: {test: {sleep: 60}}\n");
    let mut play = Process::start(ztl().current_dir(files.path("")).args(PLAY.split(' ')));
    let path = files.path("one.jsonl");
    until("the second task", PATIENCE, || {
        let text = fs::read_to_string(&path).unwrap_or_default();
        text.contains("test:sleep:60").then_some(())
    });
    play.kill();
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.ends_with('\n'), "whole lines: {text:?}");
    let ended =
        Process::run(
            ztl()
                .current_dir(files.path(""))
                .args(["report", "one.jsonl", "--csv"]),
        );
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert!(
        ended.stderr.contains("the end of one.jsonl is lacking"),
        "{ended:?}"
    );
    let tasks = fs::read_to_string(files.path("one.tasks.csv")).unwrap();
    let states: Vec<&str> = tasks
        .lines()
        .skip(1)
        .map(|line| line.rsplit(',').nth(1).unwrap())
        .collect();
    assert_eq!(states[0], "completed", "{tasks}");
    assert_eq!(states.len(), 2, "{tasks}");
}
