//! The original's names for its tools (`ztl_task_client`, `task_client.py`), and its rules for their
//! options (`docs/compatibility.md`, "Command line").
//!
//! Python's argparse, as the original uses it, ignores what it does not know; ours says on stderr what
//! was ignored. Beside an option of ours nothing is ignored, since `--yes --dryrun` must not move a robot.
//! The simple tools have no options. Called as `ztl`, none of this applies.

use std::ffi::{OsStr, OsString};
use std::path::Path;
use std::process::ExitCode;

use clap::{ArgAction, FromArgMatches};

use crate::called::Called;
use crate::terminal::{error_line, line};
use crate::tools::{Tool, ToolOnly, help, original_command};

/// The tools with the original's long options. Ours have more.
const TOOLS: [(&str, &[&str]); 8] = [
    ("task-server", &["port", "scope", "help"]),
    (
        "task-client",
        &["remote", "port", "scope", "timeout", "help"],
    ),
    ("simple-server", &[]),
    ("simple-client", &[]),
    ("simple-publisher", &["port", "scope", "help"]),
    ("simple-subscriber", &["remote", "port", "scope", "help"]),
    (
        "remote-task",
        &["timeout", "config", "publisher", "task", "help"],
    ),
    (
        "run-script",
        &["script", "config", "publisher", "task", "help"],
    ),
];

/// Runs a tool if the program was called by one of the original's names.
pub(crate) fn run(args: &[OsString]) -> Option<ExitCode> {
    let (program, words) = args.split_first()?;
    let name = Path::new(program).file_name()?.to_str()?;
    let stem = name.strip_suffix(".py").unwrap_or(name);
    let plain = stem.strip_prefix("ztl_").unwrap_or(stem).replace('_', "-");
    let (tool, options) = TOOLS.into_iter().find(|(tool, _)| *tool == plain)?;
    let called = Called::original(name);
    Some(match parse(&called, tool, options, words) {
        Ok(tool) => tool.run_as(&called),
        Err(code) => code,
    })
}

fn parse(
    called: &Called,
    tool: &str,
    options: &[&str],
    words: &[OsString],
) -> Result<Tool, ExitCode> {
    let command = original_command(tool);
    let Some(subcommand) = command.find_subcommand(tool) else {
        return Err(ExitCode::FAILURE);
    };
    // Adds `--help`.
    let mut built = subcommand.clone();
    built.build();
    let sorted = Sorted::new(&built, options, words);
    // In argparse's order: usage, then the error.
    let refuse = |wrong: &str| {
        let usage = subcommand
            .clone()
            .bin_name(called.to_string())
            .render_usage();
        let usage = usage.to_string().replacen("Usage:", "usage:", 1);
        error_line(format_args!("{usage}\n{called}: error: {wrong}"));
        // The original's simple tools fail with a traceback.
        ExitCode::from(if options.is_empty() { 1 } else { 2 })
    };
    if let (Some(ours), Some(unknown)) = (sorted.ours, sorted.ignored.first()) {
        let unknown = unknown.to_string_lossy();
        return Err(refuse(&format!(
            "unexpected argument '{unknown}'; beside --{ours}, which the original does not have, nothing is ignored"
        )));
    }
    for ignored in &sorted.ignored {
        let ignored = ignored.to_string_lossy();
        error_line(format_args!("{called}: warning: ignored {ignored}"));
    }
    let mut args: Vec<OsString> = vec!["ztl".into(), tool.into()];
    args.extend(sorted.options);
    args.push("--".into());
    args.extend(sorted.positionals);
    let parsed = command.clone().try_get_matches_from(args);
    let error = match parsed.and_then(|matches| ToolOnly::from_arg_matches(&matches)) {
        Ok(parsed) => return Ok(parsed.tool),
        Err(error) => error,
    };
    if !error.use_stderr() {
        line(help(called, tool).trim_end());
        return Err(ExitCode::SUCCESS);
    }
    let text = error.render().to_string();
    let wrong: Vec<&str> = text
        .lines()
        .take_while(|line| !line.starts_with("Usage: ") && !line.starts_with("For more"))
        .map(|line| line.trim_start_matches("error: ").trim())
        .filter(|line| !line.is_empty())
        .collect();
    Err(refuse(&wrong.join(" ")))
}

/// What argparse makes of a command line.
#[derive(Debug, Default, PartialEq, Eq)]
struct Sorted {
    /// Options with their full names and values.
    options: Vec<OsString>,
    positionals: Vec<OsString>,
    ignored: Vec<OsString>,
    /// The first option that the original does not have.
    ours: Option<String>,
}

/// How argparse reads a word.
enum Word<'a> {
    Positional,
    /// An option, with the value that is joined to it, if any.
    Option(&'a clap::Arg, Option<String>),
    /// A prefix of several options.
    Ambiguous,
    Unknown,
}

impl Sorted {
    /// Sorts `words` as argparse does. The original's `options` win over ours.
    fn new(tool: &clap::Command, options: &[&str], words: &[OsString]) -> Self {
        let mut sorted = Self::default();
        let mut rest = words.iter();
        // The simple tools have only positional arguments.
        let mut all_positional = options.is_empty();
        while let Some(word) = rest.next() {
            if word == "--" && !all_positional {
                all_positional = true;
                continue;
            }
            let meaning = match all_positional {
                true => Word::Positional,
                false => meaning(tool, options, word),
            };
            match meaning {
                Word::Positional => sorted.positionals.push(word.clone()),
                // clap rejects it.
                Word::Ambiguous => sorted.options.push(word.clone()),
                Word::Unknown => sorted.ignored.push(word.clone()),
                Word::Option(option, value) => {
                    let long = option.get_long().unwrap_or_default();
                    if !options.contains(&long) {
                        sorted.ours.get_or_insert_with(|| long.to_owned());
                    }
                    let mut name = format!("--{long}");
                    if let Some(value) = value {
                        name.push('=');
                        name.push_str(&value);
                        sorted.options.push(name.into());
                        continue;
                    }
                    let count = values(option);
                    let following = rest.as_slice().iter();
                    let found = following
                        .take(count)
                        .take_while(|word| is_value(tool, options, word));
                    let found: Vec<OsString> = found.cloned().collect();
                    match found.as_slice() {
                        // Joined, since the value may begin with a dash.
                        [value] if count == 1 => {
                            let mut joined = OsString::from(format!("{name}="));
                            joined.push(value);
                            sorted.options.push(joined);
                        }
                        values => {
                            sorted.options.push(name.into());
                            sorted.options.extend_from_slice(values);
                        }
                    }
                    for _ in found {
                        rest.next();
                    }
                }
            }
        }
        let most = tool.get_positionals().map(|arg| {
            let range = arg.get_num_args();
            range.map_or(1, |range| range.max_values())
        });
        let most = most.fold(0, usize::saturating_add);
        let surplus = most.min(sorted.positionals.len());
        let surplus = sorted.positionals.split_off(surplus);
        sorted.ignored.extend(surplus);
        sorted
    }
}

/// How many words an option takes as values.
fn values(option: &clap::Arg) -> usize {
    let takes = matches!(option.get_action(), ArgAction::Set | ArgAction::Append);
    match option.get_num_args() {
        _ if !takes || option.is_require_equals_set() => 0,
        Some(range) => range.max_values(),
        None => 1,
    }
}

fn is_value(tool: &clap::Command, options: &[&str], word: &OsStr) -> bool {
    word != "--" && matches!(meaning(tool, options, word), Word::Positional)
}

/// How argparse reads a single word.
fn meaning<'a>(tool: &'a clap::Command, options: &[&str], word: &OsStr) -> Word<'a> {
    let text = word.to_string_lossy();
    let Some(dashed) = text.strip_prefix('-').filter(|rest| !rest.is_empty()) else {
        return Word::Positional;
    };
    if let Some(long) = dashed.strip_prefix('-') {
        let (name, value) = match long.split_once('=') {
            Some((name, value)) => (name, Some(value.to_owned())),
            None => (long, None),
        };
        let known = |arg: &&clap::Arg| arg.get_long().is_some() && !arg.is_hide_set();
        let named = |is: &dyn Fn(&str) -> bool| -> Vec<&'a clap::Arg> {
            let all = tool.get_arguments().filter(known);
            all.filter(|arg| arg.get_long().is_some_and(is)).collect()
        };
        let exact = named(&|long| long == name);
        let originals = named(&|long| options.contains(&long) && long.starts_with(name));
        let any = named(&|long| long.starts_with(name));
        let found = [exact, originals, any]
            .into_iter()
            .find(|found| !found.is_empty());
        match found.as_deref() {
            Some([option]) => return Word::Option(option, value),
            Some(_) => return Word::Ambiguous,
            None => {}
        }
    } else if let Some(letter) = dashed.chars().next() {
        let mut shorts = tool.get_arguments().filter(|arg| !arg.is_hide_set());
        if let Some(option) = shorts.find(|arg| arg.get_short() == Some(letter)) {
            let joined = dashed.split_at(letter.len_utf8()).1;
            let value = joined.strip_prefix('=').unwrap_or(joined);
            return Word::Option(option, (!joined.is_empty()).then(|| value.to_owned()));
        }
    }
    if is_negative(dashed) || text.contains(' ') {
        Word::Positional
    } else {
        Word::Unknown
    }
}

/// Whether the text after a dash makes a negative number.
fn is_negative(text: &str) -> bool {
    let digits = |text: &str| text.bytes().all(|byte| byte.is_ascii_digit());
    let (whole, part) = text.split_once('.').unwrap_or(("", text));
    digits(whole) && digits(part) && !part.is_empty()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn sorts(tool: &str, line: &[&str], options: &[&str], positionals: &[&str], ignored: &[&str]) {
        let mut command = original_command(tool);
        let subcommand = command.find_subcommand_mut(tool).unwrap();
        subcommand.build();
        let (_, originals) = TOOLS.into_iter().find(|(name, _)| *name == tool).unwrap();
        let words: Vec<OsString> = line.iter().map(OsString::from).collect();
        let all = |words: &[&str]| words.iter().map(OsString::from).collect();
        let expected = Sorted {
            options: all(options),
            positionals: all(positionals),
            ignored: all(ignored),
            ours: None,
        };
        let sorted = Sorted::new(subcommand, originals, &words);
        // The tests of the command show what it is for.
        let sorted = Sorted {
            ours: None,
            ..sorted
        };
        assert_eq!(sorted, expected, "{line:?}");
    }

    #[test]
    fn words_are_sorted_as_argparse_does() {
        let client = |line: &[&str], options: &[&str], positionals: &[&str], ignored: &[&str]| {
            sorts("task-client", line, options, positionals, ignored);
        };
        client(
            &["-r", "h", "-p1", "-s=/t", "a:b:c"],
            &["--remote=h", "--port=1", "--scope=/t"],
            &["a:b:c"],
            &[],
        );
        client(
            &["--r", "h", "--s", "/t", "--po=1"],
            &["--remote=h", "--scope=/t", "--port=1"],
            &[],
            &[],
        );
        client(&["-x y:y:z"], &[], &["-x y:y:z"], &[]);
        client(&["-x", "y:y:z", "more"], &[], &["y:y:z"], &["-x", "more"]);
        client(&["-5", "-.5", "-"], &[], &["-5"], &["-.5", "-"]);
        client(&["--", "-x:y:z", "--json"], &[], &["-x:y:z"], &["--json"]);
        client(
            &["-t", "-1", "-s", "-x"],
            &["--timeout=-1", "--scope"],
            &[],
            &["-x"],
        );
        client(
            &["--exit-staus", "--exit-s", "--config", "f"],
            &["--exit-status"],
            &["f"],
            &["--exit-staus", "--config"],
        );
        client(&["--h"], &["--help"], &[], &[]);
        sorts(
            "remote-task",
            &[
                "--task", "r", "h", "1", "/t", "--t", "r", "a:b:c", "--p", "p", "h", "1", "/p",
            ],
            &[
                "--task",
                "r",
                "h",
                "1",
                "/t",
                "--t",
                "--publisher",
                "p",
                "h",
                "1",
                "/p",
            ],
            &["r", "a:b:c"],
            &[],
        );
        sorts(
            "run-script",
            &["--s", "f", "--sim", "--simualte"],
            &["--script=f", "--simulate"],
            &[],
            &["--simualte"],
        );
        sorts(
            "simple-client",
            &["h", "1", "/t", "--json", "-x"],
            &[],
            &["h", "1", "/t", "--json"],
            &["-x"],
        );
        sorts(
            "simple-publisher",
            &["-p", "1", "x"],
            &["--port=1"],
            &[],
            &["x"],
        );
    }
}
