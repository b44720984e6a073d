//! Scripts as the original reads and plays them.
//!
//! `drive.py` plays each script twice at once, by the original's own engine and by ours: each on a
//! terminal of its own, with the same keys at the same prompts, and with servers that answer like the
//! original's and record each request. PyYAML, through `scalars.py` and `documents.py`, gives the meaning of values
//! and whole files.
//!
//! The engines that run at once keep both cores busy, so these tests have a binary, and a process, of their own.

mod corpus;

use std::collections::{BTreeMap, BTreeSet};

use serde::Deserialize;
use ztl_script::read_value;
use ztl_std::Remotes;
use ztl_std::terminal::shown;
use ztl_tests::lab::{PATIENCE, built, run_python, seed, until};
use ztl_yaml::Document;
use ztl_yaml::python::PythonValue;

/// Generated scripts, and how many engines run concurrently: they mostly wait.
const MADE_UP: usize = 200;
const AT_ONCE: usize = 24;

/// Generated values and whole documents.
const VALUES: usize = 5000;
const DOCUMENTS: usize = 8000;

/// Two gaps between tasks are of one class when they differ by less: all delays and tasks last a
/// multiple of half a second. The original takes up to 0.2 s more for a step.
const CLASS: f64 = 0.45;

const INIT: u32 = 1;
const STATUS: u32 = 2;

/// The results of a script in both engines.
#[derive(Debug, Deserialize)]
struct Played {
    name: String,
    text: String,
    keys: Vec<String>,
    original: Engine,
    ours: Engine,
}

#[derive(Debug, Deserialize)]
struct Engine {
    exit: i32,
    out: String,
    err: String,
    /// Time, scope, code, id, payload.
    requests: Vec<(f64, String, u32, String, String)>,
}

impl Engine {
    /// The started tasks and their times.
    fn started(&self) -> (Vec<(&str, &str)>, Vec<f64>) {
        let inits = self.requests.iter().filter(|request| request.2 == INIT);
        inits
            .map(|(at, scope, _, _, payload)| ((scope.as_str(), payload.as_str()), at))
            .unzip()
    }

    /// The requests about each task, in order of the tasks' first request.
    fn asked(&self) -> Vec<((&str, &str), BTreeSet<&str>)> {
        let mut asked: Vec<((&str, &str), BTreeSet<&str>)> = Vec::new();
        for (_, scope, _, id, payload) in self.requests.iter().filter(|request| request.2 == STATUS)
        {
            let task = (scope.as_str(), id.as_str());
            match asked.iter_mut().find(|(known, _)| *known == task) {
                Some((_, payloads)) => {
                    payloads.insert(payload);
                }
                None => asked.push((task, BTreeSet::from([payload.as_str()]))),
            }
        }
        asked
    }
}

/// Runs a Python program, and returns the lines that it prints.
fn lines(program: &str, args: &[&str], input: &str) -> Vec<String> {
    let text = run_python(&[&["-c", program], args].concat(), input);
    text.lines().map(str::to_owned).collect()
}

/// The differences between the two.
fn differences(played: &Played) -> Vec<String> {
    let Played { original, ours, .. } = played;
    let mut found = Vec::new();
    let ((theirs, _), (started, times)) = (original.started(), ours.started());
    if theirs != started {
        found.push(format!("started:\n{theirs:#?}\nours:\n{started:#?}"));
    }
    let theirs = original.asked();
    let known: BTreeSet<_> = theirs.iter().map(|(task, _)| *task).collect();
    let (asked, background): (Vec<_>, Vec<_>) = ours
        .asked()
        .into_iter()
        .partition(|(task, _)| known.contains(task));
    if asked != theirs {
        found.push(format!("asked about:\n{theirs:#?}\nours:\n{asked:#?}"));
    }
    // A background task is queried once, at the very end, for the exit code.
    let last = times.last().copied().unwrap_or_default();
    for (task, _) in &background {
        let of_it = |request: &&(f64, String, u32, String, String)| {
            request.2 == STATUS && (request.1.as_str(), request.3.as_str()) == *task
        };
        let requests: Vec<_> = ours.requests.iter().filter(of_it).collect();
        if requests.len() != 1 || requests[0].0 < last {
            found.push(format!("about {task:?} in the background: {requests:?}"));
        }
    }
    if original.out != ours.out {
        found.push(format!("out:\n{}\nours:\n{}", original.out, ours.out));
    }
    let failed = ours.err.contains(" ended ") || ours.err.contains("COULD NOT BE TRIGGERED");
    if original.exit != 0 || ours.exit != i32::from(failed) {
        found.push(format!("exit codes {} and {}", original.exit, ours.exit));
    }
    found
}

/// Tasks whose gaps differ.
fn gaps(played: &Played) -> Vec<String> {
    let gaps = |engine: &Engine| -> Vec<f64> {
        let (_, times) = engine.started();
        times.windows(2).map(|pair| pair[1] - pair[0]).collect()
    };
    let pairs = gaps(&played.original).into_iter().zip(gaps(&played.ours));
    pairs
        .filter(|(theirs, ours)| (theirs - ours).abs() >= CLASS)
        .map(|(theirs, ours)| {
            format!("a task {theirs:.2} s after the one before, ours {ours:.2} s")
        })
        .collect()
}

/// The parts of an unplayable script that are not rejected by both.
fn refusals(played: &Played) -> Vec<String> {
    let Played { original, ours, .. } = played;
    let mut found = Vec::new();
    if (original.exit, ours.exit) != (1, 1) {
        found.push(format!("exit codes {} and {}", original.exit, ours.exit));
    }
    if !ours.requests.is_empty() {
        found.push(format!("requests: {:?}", ours.requests));
    }
    found
}

type Scripts<'a> = BTreeMap<&'a str, (&'a str, Vec<&'a str>)>;

fn named<'a>(scripts: &'a [(&str, &str, &str)]) -> Scripts<'a> {
    let scripts = scripts.iter().map(|(name, text, keys)| {
        let keys = keys.split(' ').map(corpus::key).collect();
        (*name, (*text, keys))
    });
    scripts.collect()
}

/// Plays all concurrently, in both engines.
#[track_caller]
fn drive(scripts: &Scripts<'_>, made_up: usize) -> Vec<Played> {
    let engine = built("ztl");
    let args = [
        engine.to_str().expect("a path"),
        &seed().to_string(),
        &made_up.to_string(),
        &AT_ONCE.to_string(),
    ];
    let input = serde_json::to_string(scripts).expect("JSON");
    let lines = lines(include_str!("drive.py"), &args, &input);
    let played = lines.iter().map(|line| {
        let mut played: Played = serde_json::from_str(line).expect("JSON");
        // Both write to a terminal; ours escapes control characters.
        played.original.out = shown(&played.original.out).into_owned();
        played
    });
    played.collect()
}

/// Plays these again.
fn drive_again<'a>(played: impl Iterator<Item = &'a Played>) -> Vec<Played> {
    let again = played.map(|played| {
        let keys = played.keys.iter().map(String::as_str).collect();
        (played.name.as_str(), (played.text.as_str(), keys))
    });
    let again: Scripts<'_> = again.collect();
    if again.is_empty() {
        return Vec::new();
    }
    drive(&again, 0)
}

/// How often a script is played at most if an engine misses a reply: both time out after 2 s, which a busy
/// machine may exceed.
const TRIES: usize = 4;

/// Plays all, and fails with all differences that `differences` finds.
#[track_caller]
fn play(scripts: &Scripts<'_>, made_up: usize, differences: fn(&Played) -> Vec<String>) {
    let mut wrong = String::new();
    let (mut count, mut tasks) = (0, 0);
    let mut all = drive(scripts, made_up);
    for _ in 1..TRIES {
        let missed = |played: &&Played| {
            let engines = [&played.original, &played.ours];
            let missed = engines.map(|engine| engine.err.contains("Networking error"));
            missed.contains(&true) && !differences(played).is_empty()
        };
        for again in drive_again(all.iter().filter(missed)) {
            all.retain(|played| played.name != again.name);
            all.push(again);
        }
    }
    for played in &all {
        count += 1;
        tasks += played.ours.started().0.len();
        let found = differences(played);
        if !found.is_empty() {
            let Played {
                name,
                text,
                keys,
                original,
                ours,
            } = played;
            wrong += &format!("--- {name}, keys {keys:?}:\n{text}\n{}\n", found.join("\n"));
            wrong += &format!("errors:\n{}\nours:\n{}\n", original.err, ours.err);
        }
    }
    assert!(wrong.is_empty(), "{wrong}");
    assert_eq!(count, scripts.len() + made_up);
    // A busy machine delays some tasks; an engine that waits too long does so each time.
    let mut late = all;
    late.retain(|played| !gaps(played).is_empty());
    until("the same times", 6 * PATIENCE, || {
        if late.is_empty() {
            return Some(());
        }
        let mut still = drive_again(late.iter());
        still.retain(|played| {
            let gaps = gaps(played);
            println!("{}: {gaps:?}\n{}", played.name, played.text);
            !gaps.is_empty()
        });
        late = still;
        None
    });
    assert!(
        made_up == 0 || tasks > count,
        "only {tasks} tasks were started"
    );
}

#[test]
fn every_script_rule_is_played_like_the_original() {
    play(&named(corpus::SCRIPTS), 0, differences);
}

#[test]
fn only_ours_offers_to_replay_a_scene_without_a_name() {
    let text = "~: {s: {robot: {blink: 1}}}\nb: {s: {robot: {blink: 2}}}";
    play(&named(&[("a_null", text, "enter enter")]), 0, |played| {
        let prompt = " OR ANY OTHER KEY TO SKIP\nEXECUTING SCENE 'b'";
        let [original, ours] = [
            format!(" or{}", &prompt[3..]),
            format!(", PRESS <R> TO REPLAY LAST SCENE{prompt}"),
        ];
        let expected = played.original.out.replace(&original, &ours);
        let mut found = differences(played);
        found.retain(|it| !it.starts_with("out:"));
        if played.ours.out != expected || !played.original.out.contains(&original) {
            let (theirs, ours) = (&played.original.out, &played.ours.out);
            found.push(format!("the offer to replay:\n{theirs}\nours:\n{ours}"));
        }
        found
    });
}

#[test]
fn scripts_the_original_cannot_play_are_rejected_with_its_exit_code() {
    play(&named(corpus::WRONG), 0, refusals);
}

#[test]
fn generated_scripts_are_played_like_the_original() {
    play(&BTreeMap::new(), MADE_UP, differences);
}

#[test]
fn values_are_parsed_like_pyyaml() {
    let args = [seed().to_string(), VALUES.to_string()];
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let mut wrong = Vec::new();
    let (mut count, mut errors) = (0, 0);
    for line in lines(include_str!("scalars.py"), &args, "") {
        let (text, plain, quoted): (String, Option<String>, String) =
            serde_json::from_str(&line).expect("JSON");
        count += 1;
        let read = read_value("value", format!("k: {text}\n").as_bytes());
        let ours = match &read {
            Ok(PythonValue::Map(pairs)) => match pairs.as_slice() {
                [(_, value)] => Some(value.to_string()),
                _ => None,
            },
            _ => None,
        };
        errors += usize::from(plain.is_none());
        let same = match (&plain, &read) {
            (None, Err(_)) => true,
            (Some(plain), Ok(value)) => ours.as_ref() == Some(plain) && value.to_string() == quoted,
            _ => false,
        };
        if !same {
            wrong.push(format!("{text:?}: {plain:?} {quoted:?}, ours {read:?}"));
        }
    }
    assert!(
        wrong.is_empty(),
        "{} differ:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
    assert_eq!(count, VALUES);
    assert!(errors < VALUES / 4, "{errors} are no values");
}

/// Documents that we reject and PyYAML reads, as docs/compatibility.md lists them.
fn is_refused(text: &str, error: &str) -> bool {
    let within_itself = error.contains("stands within itself") && text.contains('*');
    let half_a_character = error.contains("there is no such character");
    within_itself || half_a_character
}

/// Documents that we read and PyYAML rejects: for the content of `!!omap` or of a value that a merge replaces.
fn is_read(text: &str) -> bool {
    text.contains("<<")
}

#[test]
fn documents_are_parsed_like_pyyaml() {
    let args = [seed().to_string(), DOCUMENTS.to_string()];
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let mut wrong = Vec::new();
    let (mut count, mut read_by_both) = (0, 0);
    for line in lines(include_str!("documents.py"), &args, "") {
        let mut line: Vec<Option<String>> = serde_json::from_str(&line).expect("JSON");
        let (text, theirs) = (line[0].take().expect("a text"), line[1].take());
        count += 1;
        let ours = read_value("f", text.as_bytes());
        let same = match (&theirs, ours.as_ref()) {
            (Some(theirs), Ok(value)) => {
                read_by_both += 1;
                *theirs == PythonValue::List(vec![value.clone()]).to_string()
            }
            (Some(_), Err(error)) => is_refused(&text, &error.to_string()),
            (None, Ok(_)) => is_read(&text),
            (None, Err(_)) => true,
        };
        if !same {
            wrong.push(format!(
                "{text:?}: {theirs:?} {:?}, ours {ours:?}",
                line.get(2)
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "{} differ:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
    assert_eq!(count, DOCUMENTS);
    assert!(
        read_by_both > DOCUMENTS / 10,
        "only {read_by_both} are read"
    );
}

/// The original's configurations, and one line of JSON with the servers found in each.
const CONFIGURATIONS: &[&str] = &[
    "remotes: {a: {host: h, port: 1, scope: /s}}",
    "base: &b {host: h, port: 1}\nremotes:\n  a: {<<: *b, scope: /a}\n  b: {scope: /b, <<: *b, port: 2}",
    "x: &x {host: x, scope: /x}\ny: &y {host: y, port: 2}\nremotes:\n  a: {<<: [*x, *y]}\n  b: {<<: [*y, *x]}\n  c: {<<: *x, <<: *y}",
    "x: &x {host: x}\ny: &y {<<: *x, port: 2}\nz: &z {<<: *y, scope: /z}\nremotes: {a: *z, b: {<<: *z, port: 010}}",
    "more: &m {b: {host: h, port: 2, scope: /b}, a: {}}\nremotes:\n  <<: *m\n  a: {host: h, port: 1, scope: /a}",
    "remotes:\n  on: {host: no, port: 0x10, scope: 1:30}\n  07: {host: 1.50, port: '2', scope: \"1\"}\n  ~: {host: !!str no, port: 3, scope: 2020-01-01}",
    "remotes:\n- a: 1\n",
];

#[test]
fn configurations_resolve_to_the_same_servers_as_the_originals() {
    let program = "
import json, sys, tempfile
from ztl.core.config import ZMQEndpoints
for text in json.load(sys.stdin):
    with tempfile.NamedTemporaryFile('w', suffix='.yaml') as file:
        file.write(text); file.flush()
        sys.argv = ['run', '--config', file.name]
        remotes = ZMQEndpoints().config['remotes']
        found = remotes.items() if isinstance(remotes, dict) else []
        print(json.dumps({str(n): [str(r['host']), int(r['port']), str(r['scope'])] for n, r in found}))
";
    let input = serde_json::to_string(CONFIGURATIONS).expect("JSON");
    let found = lines(program, &[], &input);
    assert_eq!(found.len(), CONFIGURATIONS.len());
    for (text, theirs) in CONFIGURATIONS.iter().zip(found) {
        let theirs: BTreeMap<String, (String, u16, String)> =
            serde_json::from_str(&theirs).expect("JSON");
        let document = Document::parse("remotes.yaml", text.as_bytes()).expect(text);
        let ours = Remotes::read(&document).unwrap_or_default();
        let ours: BTreeMap<_, _> = ours
            .task_names()
            .map(|name| {
                let remote = ours.task(name).expect(text).clone();
                (name.to_owned(), (remote.host, remote.port, remote.scope))
            })
            .collect();
        assert_eq!(ours, theirs, "{text}");
    }
}

/// The rows of docs/compatibility.md on YAML: whether the original reads it, and whether we do.
#[test]
fn only_the_listed_yaml_differences_exist() {
    let nested = |depth: usize| format!("{}{}", "[".repeat(depth), "]".repeat(depth));
    let listed = [
        ("&a [*a]".to_owned(), true, false),
        ("&a {<<: *a, x: 1}".to_owned(), true, false),
        (nested(64), true, true),
        (nested(65), true, false),
        (nested(600), false, false),
        ("\"\\ud800\"".to_owned(), true, false),
        ("!!int {=: 5}".to_owned(), true, false),
        ("!!omap [<<: {a: 1}]".to_owned(), false, true),
        ("{<<: {a: 2020-02-30}, a: 1}".to_owned(), false, true),
        ("a:\tb".to_owned(), false, false),
        ("a: !x b".to_owned(), false, false),
        ("a: 1\na: 2".to_owned(), true, true),
    ];
    let program = "
import json, sys, oyaml as yaml
for text in json.load(sys.stdin):
    try: yaml.safe_load(text); print('true')
    except Exception: print('false')
";
    let texts: Vec<&str> = listed.iter().map(|(text, ..)| text.as_str()).collect();
    let found = lines(program, &[], &serde_json::to_string(&texts).expect("JSON"));
    let found: Vec<(String, bool, bool)> = texts
        .iter()
        .zip(found)
        .map(|(text, theirs)| {
            let ours = read_value("f", text.as_bytes()).is_ok();
            ((*text).to_owned(), theirs == "true", ours)
        })
        .collect();
    assert_eq!(found, listed);
    // In our own files.
    let own = |text: &str| {
        let parsed = Document::parse("f", text.as_bytes());
        let read = parsed.and_then(|document| document.reading().finish(Some(())));
        read.is_ok()
    };
    assert_eq!(
        [own("a:\tb"), own("a: !x b"), own("a: 1\na: 2")],
        [true, false, false]
    );
}
