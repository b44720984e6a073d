//! `ztl complete-goal`: completes the task of `ztl task-client` and `ztl remote-task` for a shell, by asking the server.
//!
//! The scripts of `ztl completions` call it. clap's own dynamic completion cannot do it: bash splits words at `:`,
//! which it takes for separate arguments, and its interface is unstable.

use std::ffi::OsString;
use std::process::ExitCode;
use std::thread;
use std::time::{Duration, Instant};

use clap::Parser as _;
use ztl_std::describe::{GoalRule, ScopeDescriptions, find};
use ztl_std::{Offers, RemoteTask};

use crate::terminal::line;
use crate::tools::Tool;
use crate::{Cli, ZtlCommand};

/// How long a shell waits.
const LIMIT: Duration = Duration::from_millis(300);

/// Stands for the word that is completed.
const CURSOR: &str = "\u{1}";

/// What a server says of the scope that a command line names.
struct Scope {
    offers: Offers,
    said: ScopeDescriptions,
}

/// Prints the words that may stand at the cursor, if the arguments are those of this verb. Nothing that goes wrong is
/// printed, since a shell would show it within the line.
pub(crate) fn run(args: &[OsString]) -> Option<ExitCode> {
    let [_, verb, form, words @ ..] = args else {
        return None;
    };
    if verb != "complete-goal" {
        return None;
    }
    let words: Option<Vec<String>> = words
        .iter()
        .map(|word| Some(word.to_str()?.to_owned()))
        .collect();
    let bash = form == "--line";
    let (words, typed) = match words.unwrap_or_default().as_slice() {
        [text, typed] if bash => {
            let mut words = Words::of(text);
            if !words.all.is_empty() {
                words.all.remove(0);
            }
            (words, Words::of(typed).last())
        }
        [words @ .., last] if !bash => {
            let mut all = Words::of(last);
            all.all = words.iter().cloned().chain([all.last()]).collect();
            (all, String::new())
        }
        _ => return Some(ExitCode::SUCCESS),
    };
    let word = words.last();
    // bash replaces a part of the word.
    let kept = match bash {
        true => word.len() - typed.len().min(word.len()),
        false => 0,
    };
    for candidate in candidates(&words) {
        if bash {
            line(words.written(candidate.get(kept..).unwrap_or_default()));
        } else {
            line(candidate);
        }
    }
    Some(ExitCode::SUCCESS)
}

/// The words that may stand at the cursor.
fn candidates(words: &Words) -> Vec<String> {
    let word = words.last();
    if word.starts_with('-') {
        return Vec::new();
    }
    let mut line: Vec<OsString> = vec!["ztl".into()];
    for before in words.all.split_last().map_or(&[][..], |(_, before)| before) {
        line.push(before.into());
    }
    line.push(CURSOR.into());
    let begin = Instant::now();
    // The thread ends with the process.
    let Ok(asking) = thread::Builder::new().spawn(move || ask(line)) else {
        return Vec::new();
    };
    while !asking.is_finished() {
        if begin.elapsed() > LIMIT {
            return Vec::new();
        }
        thread::sleep(Duration::from_millis(2));
    }
    let scope = asking.join().ok().flatten();
    let mut found = scope.map_or_else(Vec::new, |scope| scope.completed(&word));
    found.retain(|text| text.starts_with(&word) && !text.contains(char::is_control));
    found
}

/// Asks the server of a command line whose task is at the cursor.
fn ask(line: Vec<OsString>) -> Option<Scope> {
    let ZtlCommand::Tool(tool) = Cli::try_parse_from(line).ok()?.command else {
        return None;
    };
    let mut remote: RemoteTask = match tool {
        Tool::TaskClient(client) => client.remote_at(CURSOR)?,
        Tool::RemoteTask(client) => client.remote_at(CURSOR)?,
        _ => return None,
    };
    let offers = remote.describe().ok()??.scopes.remove(remote.scope());
    Some(Scope {
        offers: offers.unwrap_or_default(),
        said: remote.describe_scope().unwrap_or_default(),
    })
}

impl Scope {
    /// The tasks that a word may become, as far as the next `:`.
    fn completed(&self, word: &str) -> Vec<String> {
        let mut parts = word.splitn(3, ':');
        let (handler, component, goal) =
            (parts.next().unwrap_or_default(), parts.next(), parts.next());
        let mut all = Vec::new();
        let Some(component) = component else {
            add(&mut all, "", &mut self.offers.keys());
            add(&mut all, "", &mut self.said.keys());
            return all;
        };
        if goal.is_none() {
            let before = format!("{handler}:");
            let of = self.offers.get(handler).or_else(|| self.offers.get("*"));
            if let Some(components) = of {
                add(&mut all, &before, &mut components.iter());
            }
            let of = self.said.get(handler).or_else(|| self.said.get("*"));
            if let Some(components) = of {
                add(&mut all, &before, &mut components.keys());
            }
            return all;
        }
        let Some(is) = find(&self.said, handler, component) else {
            return Vec::new();
        };
        let goal_of = |goal: &str| format!("{handler}:{component}:{goal}");
        let mut goals = match &is.goal {
            GoalRule::OneOf(words) => words.iter().map(|word| goal_of(word)).collect(),
            GoalRule::Bool => vec![goal_of("True"), goal_of("False")],
            GoalRule::Nothing => vec![goal_of("")],
            _ => Vec::new(),
        };
        for example in is.examples.iter() {
            let goal = goal_of(example);
            if !goals.contains(&goal) {
                goals.push(goal);
            }
        }
        goals
    }
}

/// Adds each new name, between what stands before it and a `:`.
fn add(all: &mut Vec<String>, before: &str, names: &mut dyn Iterator<Item = &String>) {
    for name in names {
        let text = format!("{before}{name}:");
        if name != "*" && !all.contains(&text) {
            all.push(text);
        }
    }
}

/// A command line as a shell splits it.
#[derive(Debug, Default, PartialEq)]
struct Words {
    /// The last one is at the cursor; it may be empty.
    all: Vec<String>,
    /// The quote that is open at the cursor.
    quote: Option<char>,
}

impl Words {
    fn of(line: &str) -> Self {
        let (mut words, mut quote) = (vec![String::new()], None);
        let mut chars = line.trim_start().chars();
        while let Some(c) = chars.next() {
            let word = words.last_mut().map(|word| (word, quote));
            let Some((word, quoted)) = word else { break };
            match (c, quoted) {
                (c, Some(open)) if c == open => quote = None,
                (c, Some('\'')) => word.push(c),
                ('\\', _) => word.extend(chars.next()),
                ('\'' | '"', None) => quote = Some(c),
                (c, None) if c.is_whitespace() => {
                    if !word.is_empty() {
                        words.push(String::new());
                    }
                }
                (c, _) => word.push(c),
            }
        }
        Self { all: words, quote }
    }

    fn last(&self) -> String {
        self.all.last().cloned().unwrap_or_default()
    }

    /// A text as it is written at the cursor.
    fn written(&self, text: &str) -> String {
        let plain =
            |c: char| !c.is_ascii() || c.is_ascii_alphanumeric() || "/_-.,:=+@%".contains(c);
        let special = |c: char| match self.quote {
            Some('\'') => false,
            Some(_) => "\"\\$`".contains(c),
            None => !plain(c),
        };
        let mut written = String::new();
        for c in text.chars() {
            match (c, self.quote) {
                // Ends the quote, and begins another. bash would read `!` as a part of its history.
                ('\'', Some(quote @ '\'')) | ('!', Some(quote @ '"')) => {
                    written.extend([quote, '\\', c, quote]);
                }
                (c, _) if special(c) => written.extend(['\\', c]),
                (c, _) => written.push(c),
            }
        }
        written
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_split_as_bash_does_it() {
        for (line, words, quote) in [
            (
                "ztl  task-client a:b",
                &["ztl", "task-client", "a:b"][..],
                None,
            ),
            ("ztl 'a b':\"c d\" ", &["ztl", "a b:c d", ""], None),
            ("ztl arm:'say it", &["ztl", "arm:say it"], Some('\'')),
            (r#"ztl a\ b\:"c\"d"#, &["ztl", "a b:c\"d"], Some('"')),
            ("", &[""], None),
        ] {
            let split = Words::of(line);
            assert_eq!(
                (split.all.as_slice(), split.quote),
                (
                    words
                        .iter()
                        .map(|word| (*word).to_owned())
                        .collect::<Vec<_>>()
                        .as_slice(),
                    quote
                ),
                "{line}"
            );
        }
    }

    #[test]
    fn what_is_written_is_read_again() {
        for text in [
            "{x: 1, 'y': [\"a b\"]}",
            "$HOME",
            "it's",
            "a;b|c!",
            "`ls`",
            "ü*?",
            "\\",
        ] {
            for open in ["", "'", "\""] {
                let written = Words::of(open).written(text);
                let read = Words::of(&format!("{open}{written}"));
                assert_eq!(read.last(), text, "{open}{written}");
            }
        }
    }
}
