//! Our codecs and the original's: both read and write 20,000 messages, tasks and numbers, generated for each
//! run, and every field and every error is compared.
//!
//! Intended differences are listed in `ztl-core/tests/vectors/differences.json`. A difference that
//! is not listed fails the test, and so does an entry that no longer applies.

mod generate;

use serde_json::Value as Json;
use ztl_core::integer::Integer;
use ztl_core::message::ParseError;
use ztl_core::spec::SpecError;
use ztl_core::{Message, TaskSpec};
use ztl_tests::lab::{Random, run_python, seed};

/// Cases per run.
const CASES: usize = 20_000;

/// A case for both codecs.
#[derive(Debug)]
enum Case {
    ReadMessage(Vec<u8>),
    WriteMessage([String; 4]),
    ReadTask(String),
    WriteTask([String; 3]),
    Number(String),
}

impl Case {
    fn new(random: &mut Random) -> Self {
        match random.below(20) {
            0..8 => Self::ReadMessage(generate::wire(random)),
            8..14 => Self::ReadTask(generate::payload(random)),
            14..18 => Self::Number(generate::number(random)),
            18 => Self::WriteTask(generate::task(random)),
            _ => Self::WriteMessage([(); 4].map(|()| generate::text(random))),
        }
    }

    /// The line that describes it to `original.py`.
    fn line(&self) -> String {
        let (verb, words): (_, Vec<&[u8]>) = match self {
            Self::ReadMessage(wire) => ("message_decode", vec![wire]),
            Self::WriteMessage(fields) => {
                let fields = fields.iter().map(String::as_bytes);
                ("message_encode", fields.collect())
            }
            Self::ReadTask(text) => ("task_decode", vec![text.as_bytes()]),
            Self::WriteTask(parts) => {
                let parts = parts.iter().map(String::as_bytes);
                ("task_encode", parts.collect())
            }
            Self::Number(field) => ("a_number", vec![field.as_bytes()]),
        };
        let words = words.into_iter().map(|word| format!(" {}", hex(word)));
        let words: String = words.collect();
        format!("{verb}{words}\n")
    }

    /// Runs it and compares the result with the original's.
    fn compare(&self, theirs: &Json, differences: &mut Differences) -> Result<(), String> {
        match self {
            Self::ReadMessage(wire) => read_message(wire, theirs, differences),
            Self::WriteMessage([scope, state, id, payload]) => {
                let message = Message {
                    scope,
                    state,
                    id,
                    payload,
                };
                let mut buffer = vec![0xA5; message.encoded_len()];
                let written = message.encode_into(&mut buffer).map(hex);
                same("bytes", written.ok().as_deref(), theirs["bytes"].as_str())
            }
            Self::ReadTask(text) => read_task(text, theirs),
            Self::WriteTask(parts) => {
                let spec = generate::spec(parts);
                let mut buffer = vec![0xA5; spec.encoded_len()];
                let written = spec.encode_into(&mut buffer).ok();
                same("text", written, theirs["text"].as_str())
            }
            Self::Number(field) => number(field, &theirs["numbers"]["field"], differences),
        }
    }
}

fn read_message(wire: &[u8], theirs: &Json, differences: &mut Differences) -> Result<(), String> {
    let fields = &theirs["fields"];
    let message = match Message::parse(wire) {
        Ok(message) => message,
        Err(ParseError::NotUtf8 { at, .. }) => {
            same(
                "error",
                Some("UnicodeDecodeError"),
                theirs["error"].as_str(),
            )?;
            return same("place", Some(at as u64), theirs["at"].as_u64());
        }
        Err(ParseError::MissingFields { found, scope }) => {
            same(
                "fields",
                Some(found),
                fields.as_object().map(|fields| fields.len()),
            )?;
            return same("scope", Some(scope), fields["scope"].as_str());
        }
        Err(other) => return Err(format!("an error that this test does not know: {other}")),
    };
    for (name, ours) in [
        ("scope", message.scope),
        ("state", message.state),
        ("id", message.id),
        ("payload", message.payload),
    ] {
        same(name, Some(ours), fields[name].as_str())?;
    }
    number(message.state, &theirs["numbers"]["state"], differences)?;
    number(message.id, &theirs["numbers"]["id"], differences)
}

fn read_task(text: &str, theirs: &Json) -> Result<(), String> {
    let fields = &theirs["fields"];
    let parts = fields.as_object().map(|fields| fields.len());
    let mut buffer = vec![0xA5; text.len() * 3 / 4];
    match TaskSpec::decode(text, &mut buffer) {
        Ok(spec) => {
            same("parts", Some(3), parts)?;
            same("handler", Some(spec.handler), fields["handler"].as_str())?;
            same(
                "component",
                Some(spec.component),
                fields["component"].as_str(),
            )?;
            same("goal", Some(spec.goal), fields["goal"].as_str())
        }
        Err(SpecError::NoComponent) => same("parts", Some(1), parts),
        Err(SpecError::NoGoal) => same("parts", Some(2), parts),
        Err(SpecError::Base64(cause)) => {
            same("error", Some("Error"), theirs["error"].as_str())?;
            same(
                "text",
                Some(cause.to_string().as_str()),
                theirs["text"].as_str(),
            )
        }
        Err(SpecError::NotUtf8 { at }) => {
            same(
                "error",
                Some("UnicodeDecodeError"),
                theirs["error"].as_str(),
            )?;
            same("place", Some(at as u64), theirs["at"].as_u64())
        }
        Err(other) => Err(format!("an error that this test does not know: {other}")),
    }
}

fn number(field: &str, theirs: &Json, differences: &mut Differences) -> Result<(), String> {
    let ours = plain(field);
    let value = theirs["int"].as_str();
    if ours.as_deref() == value {
        let fits = Integer::parse(field).ok().and_then(Integer::value);
        return same("value", fits, value.and_then(|digits| digits.parse().ok()));
    }
    if ours.is_none() && differences.explain(theirs) {
        return Ok(());
    }
    same("number", ours.as_deref(), value)
}

/// A number in plain digits, if the value is a number.
fn plain(field: &str) -> Option<String> {
    let mut digits = Vec::new();
    let number = Integer::parse(field).ok()?;
    number.put(&mut |bytes: &[u8]| digits.extend_from_slice(bytes));
    String::from_utf8(digits).ok()
}

fn same<T: PartialEq + std::fmt::Debug>(
    what: &str,
    ours: Option<T>,
    theirs: Option<T>,
) -> Result<(), String> {
    if ours == theirs {
        return Ok(());
    }
    Err(format!("{what}: ours {ours:?}, the original's {theirs:?}"))
}

/// The list, and how often each entry applied.
struct Differences(Vec<Difference>);

struct Difference {
    name: String,
    examples: Vec<String>,
    met: usize,
}

impl Differences {
    fn listed() -> Self {
        let list = include_str!("../../../ztl-core/tests/vectors/differences.json");
        let list: Json = serde_json::from_str(list).expect("JSON");
        let entry = |entry: &Json| Difference {
            name: entry["name"].as_str().expect("a name").to_owned(),
            examples: serde_json::from_value(entry["examples"].clone()).expect("texts"),
            met: 0,
        };
        let numbers = list["numbers"].as_array().expect("a list");
        Self(numbers.iter().map(entry).collect())
    }

    /// Whether a field that only the original reads is of a listed kind and has no other
    /// problem.
    fn explain(&mut self, theirs: &Json) -> bool {
        let ascii = theirs["ascii"].as_str().and_then(plain);
        if ascii.is_none() || ascii.as_deref() != theirs["int"].as_str() {
            return false;
        }
        let kinds = theirs["kinds"].as_array().expect("a list");
        let listed = kinds.iter().all(|kind| {
            let mut entries = self.0.iter_mut();
            let entry = entries.find(|entry| *kind == *entry.name);
            entry.map(|entry| entry.met += 1).is_some()
        });
        listed && !kinds.is_empty()
    }
}

/// The original's result for each case.
fn original(cases: &[Case]) -> Vec<Json> {
    let lines: String = cases.iter().map(Case::line).collect();
    let text = run_python(&["-X", "utf8", "-c", include_str!("original.py")], &lines);
    let answers: Vec<Json> = text
        .lines()
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect();
    assert_eq!(answers.len(), cases.len(), "an answer for each case");
    answers
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn unusual_messages_are_read_and_written_like_the_original() {
    let seed = seed();
    let mut random = Random::new(seed);
    let cases: Vec<Case> = (0..CASES).map(|_| Case::new(&mut random)).collect();
    let mut differences = Differences::listed();
    let answers = original(&cases);
    let mut refused = 0;
    for (place, (case, theirs)) in cases.iter().zip(&answers).enumerate() {
        if let Err(difference) = case.compare(theirs, &mut differences) {
            panic!("ZTL_SEED={seed}, case {place}: {difference}\n{case:?}\n{theirs}");
        }
        refused += usize::from(theirs["error"].is_string());
    }
    // If all are valid or all are broken, the generator is wrong.
    assert!(
        (CASES / 20..CASES / 2).contains(&refused),
        "{refused} refused"
    );
    for entry in differences.0 {
        assert!(
            entry.met > CASES / 1000,
            "{} was met {} times",
            entry.name,
            entry.met
        );
    }
}

#[test]
fn only_the_original_reads_the_listed_differences() {
    let mut differences = Differences::listed();
    let examples: Vec<Case> = differences
        .0
        .iter()
        .flat_map(|entry| entry.examples.iter().cloned().map(Case::Number))
        .collect();
    assert!(!examples.is_empty());
    for (case, theirs) in examples.iter().zip(original(&examples)) {
        let Case::Number(field) = case else { continue };
        let theirs = &theirs["numbers"]["field"];
        assert!(
            theirs["int"].is_string(),
            "the original refuses {field:?} too"
        );
        assert_eq!(plain(field), None, "ours reads {field:?} too");
        assert!(differences.explain(theirs), "{field:?} is of another kind");
    }
}
