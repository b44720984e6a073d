//! Random values that Python pickles in every protocol and way, read by us, and what we write, read by Python 3 and
//! 2.7. Values are compared as a canonical text that shows types, order, and which lists are the same one.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::process::{Command, Stdio};

use ztl_pickle::{DType, ElementKind, Kind, Pickle, Time, TimeDelta, TimeZone, Value};
use ztl_tests::lab::{busy, python, python27, seed};

/// Values per run; each has up to 19 pickles.
const CASES: usize = 4_000;
const SCRIPT: &str = include_str!("original.py");

/// Runs the script with this Python; returns its lines.
fn run(python: &mut Command, args: &[&str], input: &str) -> Vec<String> {
    let python = python.args(["-W", "ignore", "-c", SCRIPT]).args(args);
    let mut process = python
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("Python starts");
    let mut stdin = process.stdin.take().expect("a pipe");
    stdin.write_all(input.as_bytes()).expect("Python reads");
    drop(stdin);
    let mut text = String::new();
    let stdout = process.stdout.as_mut().expect("a pipe");
    stdout.read_to_string(&mut text).expect("UTF-8");
    let status = process.wait().expect("Python ends");
    assert!(status.success(), "Python failed with {status}: {args:?}");
    text.lines().map(str::to_owned).collect()
}

fn python3() -> Command {
    Command::new(python())
}

/// Python 2.7, if the machine has one.
fn python2() -> Option<Command> {
    let python = python27()?;
    let mut command = Command::new(&python);
    command.env("PYTHONPATH", python.parent()?);
    Some(command)
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

fn unhex(text: &str) -> Vec<u8> {
    let pairs = text.as_bytes().chunks(2);
    let pair = |pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    pairs.map(pair).collect()
}

/// Where a value is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    /// In Python, which made it.
    Made,
    /// In Python 3, which loaded it: numpy changes the byte order of some arrays.
    Loaded,
    /// In Python 2, where a dict has no order, either.
    LoadedByPython2,
}

/// The text that the script has for the same value.
fn canon(value: Value<'_>, place: Place) -> String {
    let mut text = String::new();
    let numbers = HashMap::new();
    Canon { numbers, place }.put(value, &mut text);
    text
}

struct Canon {
    /// Of the mutable values that were met.
    numbers: HashMap<u32, usize>,
    place: Place,
}

impl Canon {
    fn put(&mut self, value: Value<'_>, out: &mut String) {
        let kind = value.kind();
        let is_mutable = matches!(
            kind,
            Kind::List(_)
                | Kind::Dict(_)
                | Kind::OrderedDict(_)
                | Kind::Set(_)
                | Kind::ByteArray(_)
        );
        if is_mutable {
            let (id, next) = (value.id().expect("an id"), self.numbers.len());
            if let Some(number) = self.numbers.get(&id) {
                *out += &format!("@{number}");
                return;
            }
            self.numbers.insert(id, next);
        }
        *out += &match kind {
            Kind::None => "N".into(),
            Kind::Bool(value) => (if value { "True" } else { "False" }).into(),
            Kind::Int(value) => format!("i{value}"),
            Kind::BigInt(value) => format!("i{value}"),
            Kind::Float(value) if value.is_nan() => "fnan".into(),
            Kind::Float(value) => format!("f{}", hex(&value.to_be_bytes())),
            Kind::Str(text) => format!("s{}", hex(text.as_bytes())),
            Kind::BrokenStr(bytes) => format!("s{}", hex(bytes)),
            Kind::Bytes(bytes) => format!("b{}", hex(bytes)),
            Kind::ByteArray(bytes) => format!("a{}", hex(bytes)),
            Kind::List(items) => format!("[{}]", self.each(items).join(",")),
            Kind::Tuple(items) => format!("({})", self.each(items).join(",")),
            Kind::Set(items) => format!("S{{{}}}", self.sorted(items)),
            Kind::FrozenSet(items) => format!("F{{{}}}", self.sorted(items)),
            Kind::Dict(entries) => {
                let mut entries: Vec<_> = entries.collect();
                if self.place == Place::LoadedByPython2 {
                    entries.sort_by_cached_key(|(key, _)| canon(*key, self.place));
                }
                format!("D{{{}}}", self.entries(entries.into_iter()))
            }
            Kind::OrderedDict(entries) => format!("O{{{}}}", self.entries(entries)),
            Kind::Array(array) => {
                let lengths: Vec<String> = array.shape().iter().map(usize::to_string).collect();
                let (mut dtype, mut data) = (array.dtype().code(), array.data().to_vec());
                if self.place != Place::Made && array.dtype().is_big_endian() {
                    dtype.replace_range(..1, "<");
                    data.chunks_mut(part(array.dtype()))
                        .for_each(<[u8]>::reverse);
                }
                let fortran = u8::from(array.is_fortran());
                let (lengths, data) = (lengths.join(", "), hex(&data));
                format!("A({dtype} [{lengths}] {fortran} {data})")
            }
            Kind::Scalar(scalar) => {
                format!("n({} {})", scalar.dtype().code(), hex(scalar.data()))
            }
            Kind::DType(dtype) if self.place != Place::Made => {
                format!("t{}", dtype.code().replace('>', "<"))
            }
            Kind::DType(dtype) => format!("t{}", dtype.code()),
            Kind::Date(date) => format!("d({}-{}-{})", date.year, date.month, date.day),
            Kind::Time(time) => format!("d({})", clock(time)),
            Kind::DateTime(moment) => {
                let (date, time) = (moment.date, clock(moment.time));
                format!("d({}-{}-{} {time})", date.year, date.month, date.day)
            }
            Kind::TimeDelta(value) => delta(value),
            Kind::TimeZone(value) => zone(value),
            other => panic!("an unknown kind: {other:?}"),
        };
    }

    fn each<'a>(&mut self, items: impl Iterator<Item = Value<'a>>) -> Vec<String> {
        let text = |item| {
            let mut text = String::new();
            self.put(item, &mut text);
            text
        };
        items.map(text).collect()
    }

    fn sorted<'a>(&mut self, items: impl Iterator<Item = Value<'a>>) -> String {
        let mut items = self.each(items);
        items.sort();
        items.join(",")
    }

    fn entries<'a>(&mut self, entries: impl Iterator<Item = (Value<'a>, Value<'a>)>) -> String {
        let text = |(key, value)| self.each([key, value].into_iter()).join(":");
        entries.map(text).collect::<Vec<_>>().join(",")
    }
}

/// The bytes that have an order.
fn part(dtype: DType) -> usize {
    match dtype.kind() {
        ElementKind::Complex => dtype.size() / 2,
        ElementKind::Text => 4,
        _ => dtype.size(),
    }
}

fn clock(time: Time<'_>) -> String {
    let Time {
        hour,
        minute,
        second,
        micros,
        fold,
        ..
    } = time;
    let zone = time.zone.map(zone).unwrap_or_default();
    format!("{hour}:{minute}:{second}.{micros}/{}{zone}", u8::from(fold))
}

fn delta(value: TimeDelta) -> String {
    format!("d({},{},{})", value.days, value.seconds, value.micros)
}

fn zone(value: TimeZone<'_>) -> String {
    let name = value.name.map(|name| format!(" {}", hex(name.as_bytes())));
    format!("z({}{})", delta(value.offset), name.unwrap_or_default())
}

/// Shows where two texts differ: they may be long.
#[track_caller]
fn assert_same(ours: &str, theirs: &str, about: impl FnOnce() -> String) {
    let equal = ours
        .chars()
        .zip(theirs.chars())
        .take_while(|(one, other)| one == other);
    let start = equal.count().saturating_sub(60);
    let part = |text: &str| text.chars().skip(start).take(200).collect::<String>();
    assert!(
        ours == theirs,
        "{}\n  ours: ...{}\ntheirs: ...{}",
        about(),
        part(ours),
        part(theirs)
    );
}

/// A value, as we have read it.
struct Case {
    canon: String,
    pickle: Pickle,
}

/// Reads all that this Python makes, and compares the values and their texts.
fn read_all(python: &mut Command, seed: u64, cases: usize) -> Vec<Case> {
    let args = ["make", &seed.to_string(), &cases.to_string()];
    let mut shown = 0;
    let mut read = Vec::new();
    for (place, line) in run(python, &args, "").iter().enumerate() {
        let about = || format!("ZTL_SEED={seed}, value {place}");
        let mut parts = line.split('\t');
        let (expected, repr) = (parts.next().unwrap(), parts.next().unwrap());
        let mut last = None;
        for bytes in parts.map(unhex) {
            let pickle = match Pickle::read(&bytes) {
                Ok(pickle) => pickle,
                Err(error) => panic!("{}: {error}\n{}\n{expected}", about(), bytes.escape_ascii()),
            };
            let found = canon(pickle.value(), Place::Made);
            assert_same(&found, expected, || {
                format!("{}\n{}", about(), bytes.escape_ascii())
            });
            // What is written means the same to us, too.
            let again = Pickle::read(&pickle.to_bytes()).expect("our own pickle");
            assert_eq!(again, pickle, "{}", about());
            assert_same(&canon(again.value(), Place::Made), expected, about);
            last = Some(pickle);
        }
        let pickle = last.expect("a pickle");
        if !repr.is_empty() {
            let ours = pickle.value().repr().most(usize::MAX).to_string();
            let repr = String::from_utf8(unhex(repr)).expect("UTF-8");
            assert_same(&ours, &repr, about);
            shown += 1;
        }
        let canon = expected.to_owned();
        read.push(Case { canon, pickle });
    }
    assert!(read.len() > cases * 9 / 10, "only {} values", read.len());
    // Arrays are not printed as by numpy; everything else is.
    assert!(shown == 0 || shown > cases / 2, "only {shown} texts");
    read
}

/// Lets this Python load what we write of these, with our JSON, and compares the values.
fn write_all<'a>(
    python: &mut Command,
    seed: u64,
    cases: impl Iterator<Item = &'a Case> + Clone,
    place: Place,
) {
    let mut input = String::new();
    for Case { pickle, .. } in cases.clone() {
        let json = pickle.value().to_json(usize::MAX).ok();
        let json = json.filter(|_| place == Place::Loaded).unwrap_or_default();
        let _ = writeln!(
            input,
            "{}\t{}",
            hex(&pickle.to_bytes()),
            hex(json.as_bytes())
        );
    }
    let loaded = run(python, &["load"], &input);
    assert_eq!(loaded.len(), cases.clone().count());
    for (index, (case, loaded)) in cases.zip(loaded).enumerate() {
        let ours = canon(case.pickle.value(), place);
        assert_same(&ours, &loaded, || {
            format!("ZTL_SEED={seed}, value {index}, loaded")
        });
    }
}

/// Python 2 knows no time zones, no fold, and no text with surrogates in pairs. Several keys that are `nan` come in any
/// order.
fn is_known_to_python2(case: &&Case) -> bool {
    let new = ["z(", "/1", "eda0bd", "edb080", "eda080"];
    let is_known = !new.iter().any(|part| case.canon.contains(part));
    is_known && case.canon.matches("fnan").count() < 2
}

#[test]
fn values_of_python_3_are_read_printed_and_written_as_by_python() {
    let _busy = busy();
    let seed = seed();
    let cases = read_all(&mut python3(), seed, CASES);
    write_all(&mut python3(), seed, cases.iter(), Place::Loaded);
    let Some(mut python2) = python2() else {
        eprintln!("left out: Python 2.7, which this machine has not");
        return;
    };
    write_all(
        &mut python2,
        seed,
        cases.iter().filter(is_known_to_python2),
        Place::LoadedByPython2,
    );
}

#[test]
fn values_of_python_2_are_read_and_written_for_both() {
    let _busy = busy();
    let seed = seed();
    let (Some(mut maker), Some(mut python)) = (python2(), python2()) else {
        eprintln!("left out: Python 2.7, which this machine has not");
        return;
    };
    let cases = read_all(&mut maker, seed, CASES / 2);
    write_all(&mut python3(), seed, cases.iter(), Place::Loaded);
    let known = cases.iter().filter(is_known_to_python2);
    write_all(&mut python, seed, known, Place::LoadedByPython2);
}

#[test]
fn large_values_of_python_take_no_more_memory_than_they_may() {
    let _busy = busy();
    for (place, line) in run(&mut python3(), &["large"], "").iter().enumerate() {
        for (protocol, bytes) in line.split('\t').map(unhex).enumerate() {
            if let Err(error) = Pickle::read(&bytes) {
                panic!("value {place} of `large`, protocol {protocol}: {error}");
            }
        }
    }
}
