//! Goals and results against what makes and reads them: Python's `repr` and `ast.literal_eval`, and
//! PyYAML's `safe_dump` and `safe_load`.
//!
//! Python makes up values and writes each in its ways, after checking that its own readers read
//! them back (`generate.py`). Ours read the same texts; what ours write is the same text as Python's.
//! What is different on purpose is one list (`differences.rs`).

mod differences;
mod value;

use std::collections::BTreeMap;
use std::thread;

use differences::{DIFFERENCES, Reader};
use serde_json::Value as Json;
use value::Value;
use ztl_core::goal::{self, GoalError, GoalErrorKind};
use ztl_tests::lab::{run_python, seed};

/// Values made up by each of as many processes.
const VALUES: usize = 10_000;
const PROCESSES: usize = 2;

/// Runs `generate.py`, and gives the lines that it writes.
fn generate(args: &[&str], input: &str) -> Vec<Json> {
    let program = ["-c", include_str!("generate.py")];
    let text = run_python(&[&program[..], args].concat(), input);
    let line = |line| serde_json::from_str(line).expect("JSON");
    text.lines().map(line).collect()
}

/// Reads without being told what to expect.
fn read(text: &str) -> Result<Value, GoalError> {
    let mut scratch = vec![0xA5; text.len() * 3 / 2];
    goal::from_str_with(text, &mut scratch)
}

/// Whether a text is read as the value; a number of more than 64 bits is refused as that.
fn reads(text: &str, value: &Value) -> bool {
    match read(text) {
        Ok(read) => read == *value,
        Err(error) => error.kind == GoalErrorKind::OutOfRange && value.any(&Value::is_huge),
    }
}

#[test]
fn goals_written_by_python_and_yaml_are_read_and_written_like_python() {
    let seed = seed();
    let makers = (0..PROCESSES).map(|process| {
        let seed = seed.wrapping_add(process as u64).to_string();
        thread::spawn(move || generate(&["values", &seed, &VALUES.to_string()], ""))
    });
    let makers: Vec<_> = makers.collect();
    let mut excused = BTreeMap::new();
    let (mut values, mut of_yaml) = (0, 0);
    for maker in makers {
        for line in maker.join().expect("Python's values") {
            let value = Value::from_told(&line["value"]);
            let text = |form: &str| line[form].as_str();
            values += 1;
            check_python(&value, text("repr").expect("always there"), seed);
            if let Some(text) = text("str") {
                check_written(&value, text, seed);
            }
            if let Some(text) = text("yaml") {
                of_yaml += 1;
                if let Some(why) = check_yaml(&value, text, seed) {
                    *excused.entry(why).or_insert(0) += 1;
                }
            }
        }
    }
    println!("{values} values, {of_yaml} of them also as YAML; of these excused:");
    for (why, count) in &excused {
        println!("{count:6} {why}");
    }
    assert_eq!(values, VALUES * PROCESSES);
    let excused: usize = excused.values().sum();
    assert!(excused < of_yaml / 10, "too much is excused");
}

/// `repr`, as it stands within a goal. A goal that is a text has no quotes; see `check_written`.
#[track_caller]
fn check_python(value: &Value, text: &str, seed: u64) {
    assert!(
        reads(text, value),
        "ZTL_SEED={seed}: {text}\n is read as {:?}",
        read(text)
    );
}

/// `str`, which is the goal, and the result.
#[track_caller]
fn check_written(value: &Value, text: &str, seed: u64) {
    if let Value::Text(value) = value {
        assert_eq!(goal::from_str::<&str>(text), Ok(value.as_str()));
        assert_eq!(goal::from_str::<String>(text).as_ref(), Ok(value));
    } else {
        check_python(value, text, seed);
    }
    // Our values do not include numbers of more than 64 bits.
    if !value.any(&Value::is_huge) {
        let mut buffer = vec![0xA5; text.len()];
        let written = goal::to_slice(value, &mut buffer);
        assert_eq!(written, Ok(text), "ZTL_SEED={seed}");
    }
}

/// `safe_dump`; the reason why it may be read differently, if it is.
#[track_caller]
fn check_yaml(value: &Value, text: &str, seed: u64) -> Option<&'static str> {
    // The end marker of a document that is not a collection.
    let text = text.trim_end_matches('\n').trim_end_matches("\n...");
    if reads(text, value) {
        return None;
    }
    let excuse = DIFFERENCES
        .iter()
        .find(|difference| value.any(&|value| (difference.excuses)(value)));
    let Some(excuse) = excuse else {
        panic!("ZTL_SEED={seed}: {text}\n is read as {:?}", read(text));
    };
    Some(excuse.why)
}

#[test]
fn each_listed_difference_still_exists() {
    let examples = || {
        let pair = |difference: &'static differences::Difference| {
            let each = difference.examples.iter();
            each.map(move |example| (difference, example))
        };
        DIFFERENCES.iter().flat_map(pair)
    };
    let mut input = String::new();
    for (difference, (text, ..)) in examples() {
        let reader = match difference.reader {
            Reader::Python => "python",
            Reader::Yaml => "yaml",
        };
        input += &format!("{}\n", serde_json::json!([reader, text]));
    }
    let read_there = generate(&["read"], &input);
    assert_eq!(read_there.len(), examples().count());
    for ((difference, (text, theirs, ours)), told) in examples().zip(read_there) {
        let why = difference.why;
        assert_eq!(told, theirs.told(), "{text}: not read so any more; {why}");
        let read_here = read(text).ok();
        assert_eq!(
            read_here.as_ref().map(Value::to_told),
            ours.value(),
            "{text}: {why}"
        );
        assert_ne!(
            read_here,
            Some(Value::from_told(&told)),
            "{text} is read alike; {why}"
        );
    }
}
