//! The meaning of keys.

use ztl_script::event::{Question, RunCommand, StepOutline};

use ztl_script::board::RunBoard;

/// Whether a key stops tasks.
pub(super) fn stops(key: &str) -> bool {
    matches!(key, "Ctrl-C" | "Ctrl-X" | "c" | "C" | "x" | "X")
}

/// Whether a key moves the visible part.
pub(super) fn scrolls(key: &str) -> bool {
    matches!(key, "Up" | "Down" | "PageUp" | "PageDown" | "Home" | "End")
}

/// The letters that mean something else; a cue with one of them is started from the page of cues.
const OWN: &str = "adgjkpqrst";

/// How the key of a cue is pressed here; nothing if it stops tasks, which goes before.
pub(super) fn of_cue(key: char) -> Option<String> {
    match key {
        key if stops(&key.to_string()) => None,
        key if OWN.contains(key) => Some(format!("k {key}")),
        key => Some(key.to_string()),
    }
}

/// The cue that a key starts. `on_page`: the page of cues is open.
pub(super) fn cue(key: &str, cues: &[StepOutline], on_page: bool) -> Option<usize> {
    let key = key.to_lowercase();
    let is_it = |cue: &StepOutline| {
        let own = cue.key.filter(|own| own.to_string() == key);
        let pressed = own.and_then(of_cue);
        pressed.is_some_and(|pressed| on_page || pressed == key)
    };
    cues.iter().position(is_it)
}

/// The command of a key, if it is among the choices.
pub(super) fn command(
    key: &str,
    choices: &[RunCommand],
    question: Option<Question>,
) -> Option<RunCommand> {
    let wanted = match key {
        "Enter" => RunCommand::Start,
        "s" | "S" => RunCommand::Skip,
        "r" | "R" => RunCommand::Replay,
        "a" | "A" => RunCommand::Restart,
        "p" | "P" if choices.contains(&RunCommand::Resume) => RunCommand::Resume,
        "p" | "P" => RunCommand::Pause,
        "t" | "T" => RunCommand::Retry,
        "g" | "G" => RunCommand::GoOn,
        // Without known choices, the player decides.
        "c" | "C" if choices.is_empty() => return Some(RunCommand::StopScene),
        "c" | "C" => RunCommand::StopScene,
        // Everything is being stopped already.
        "x" | "X" | "Ctrl-X" if matches!(choices, [RunCommand::Leave] | [RunCommand::Stop]) => {
            return None;
        }
        // Accepted at any time.
        "x" | "X" | "Ctrl-X" => return Some(RunCommand::StopAll),
        // The second press leaves even if tasks still run.
        "Ctrl-C" if choices == [RunCommand::Leave] => RunCommand::Leave,
        "Ctrl-C" => return Some(RunCommand::Stop),
        "q" | "Q" if may_leave(question) => RunCommand::Leave,
        _ => return None,
    };
    choices.contains(&wanted).then_some(wanted)
}

/// Only between scenes: leaving in the middle of a step would let the robot move unattended.
const fn may_leave(question: Option<Question>) -> bool {
    matches!(question, Some(Question::Scene { .. } | Question::End))
}

/// The keys that work now, for the last lines of the screen.
pub(super) fn help(board: &RunBoard) -> Vec<(&'static str, String)> {
    let choices = board.choices();
    let question = board.question;
    let mut keys = Vec::new();
    let mut offer = |key, command, words: &str| {
        if choices.contains(&command) {
            keys.push((key, words.to_owned()));
        }
    };
    offer("Enter", RunCommand::Start, "start");
    offer(
        "s",
        RunCommand::Skip,
        match question {
            Some(Question::Scene { .. }) => "skip",
            _ => "skip the rest of the scene",
        },
    );
    offer("r", RunCommand::Replay, "replay last");
    offer("t", RunCommand::Retry, "retry what failed");
    offer("g", RunCommand::GoOn, "go on anyway");
    match (question, board.pause) {
        (Some(Question::Pause), _) => offer("p", RunCommand::Resume, "go on"),
        (_, true) => offer("p", RunCommand::Resume, "no pause after this step"),
        _ => offer("p", RunCommand::Pause, "pause after this step"),
    }
    offer("a", RunCommand::Restart, "begin again");
    if choices
        .iter()
        .any(|choice| matches!(choice, RunCommand::Jump { .. }))
    {
        keys.push(("j", "jump to a scene".to_owned()));
    }
    if may_leave(question) && choices.contains(&RunCommand::Leave) {
        let words = match board.in_background().count() {
            0 => "leave".to_owned(),
            1 => "leave (1 task runs on)".to_owned(),
            tasks => format!("leave ({tasks} tasks run on)"),
        };
        keys.push(("q", words));
    }
    match choices.as_slice() {
        _ if board.ended.is_some() => {}
        [RunCommand::Leave] => keys.push(("Ctrl-C", "leave without waiting".to_owned())),
        [RunCommand::Stop] => keys.push(("Ctrl-C", "stop and leave".to_owned())),
        choices => {
            if choices.contains(&RunCommand::StopScene) {
                keys.push(("c", "stop this scene".to_owned()));
            }
            keys.push(("x", "stop everything".to_owned()));
        }
    }
    if board.has_cues() && board.ended.is_none() {
        keys.push(("k", "cues".to_owned()));
    }
    if board.has_details() {
        keys.push(("d", "details".to_owned()));
    }
    if board.ended.is_none() {
        keys.push(("?", "keys".to_owned()));
    }
    keys
}

/// The keys of the chooser.
pub(super) fn choosing() -> Vec<(&'static str, String)> {
    let keys = [
        ("Enter", "show it"),
        ("0-9", "its number"),
        ("a-z", "search"),
        ("Up Down Page Home End", "move"),
        ("Esc", "do not jump"),
        ("Ctrl-X", "stop everything"),
    ];
    keys.map(|(key, words)| (key, words.to_owned())).to_vec()
}

/// The keys of a page, or while scrolled.
pub(super) fn looking() -> Vec<(&'static str, String)> {
    vec![("Esc", "back".to_owned())]
}

/// The keys of the page of cues.
pub(super) fn cueing() -> Vec<(&'static str, String)> {
    let keys = [("a-z 0-9", "start the cue"), ("Esc", "back")];
    keys.map(|(key, words)| (key, words.to_owned())).to_vec()
}

/// All keys, for the page of `?`.
pub(super) const ALL: [(&str, &str); 20] = [
    ("Enter", "start the scene that is shown"),
    ("s", "skip it; while a step waits: the rest of its scene"),
    ("r", "play the last scene again"),
    ("j", "choose a scene by number or name; Enter only shows it"),
    ("a", "begin again with the first scene"),
    ("p", "pause after this step, or go on"),
    ("t", "retry what failed"),
    ("g", "go on although something failed or is unknown"),
    (
        "c",
        "stop the tasks of this scene, and return to the scenes",
    ),
    (
        "x",
        "stop everything on the servers of the show, and stay in it",
    ),
    ("Ctrl-X", "the same, also while a scene is chosen"),
    (
        "Ctrl-C",
        "stop all that this run started, and leave; again: at once",
    ),
    ("q", "between scenes: leave; background tasks continue"),
    ("k", "show the cues and their keys, and start one"),
    ("PageUp, PageDown", "scroll, as do Up, Down, Home and End"),
    ("d", "show failures in full"),
    ("?", "these keys"),
    ("Esc", "back to the run"),
    ("Ctrl-L", "draw the screen again"),
    ("Ctrl-Z", "suspend this program; the servers continue"),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_gives_only_an_available_command() {
        let at_scene = Some(Question::Scene { scene: 0 });
        let choices = [RunCommand::Start, RunCommand::Skip, RunCommand::Leave];
        assert_eq!(
            command("Enter", &choices, at_scene),
            Some(RunCommand::Start)
        );
        assert_eq!(command("r", &choices, at_scene), None);
        assert_eq!(command("q", &choices, at_scene), Some(RunCommand::Leave));
        let at_step = Some(Question::Step { scene: 0, step: 0 });
        assert_eq!(command("q", &choices, at_step), None, "the robot may move");
        assert_eq!(command("c", &choices, at_scene), None, "nothing is played");
        let playing = RunCommand::WHILE_RUNNING;
        assert_eq!(command("c", &playing, None), Some(RunCommand::StopScene));
        assert_eq!(command("c", &[], at_step), Some(RunCommand::StopScene));
        for key in ["x", "X", "Ctrl-X"] {
            assert_eq!(command(key, &[], None), Some(RunCommand::StopAll));
            assert_eq!(
                command(key, &[RunCommand::Stop], None),
                None,
                "it is stopped"
            );
            assert_eq!(command(key, &[RunCommand::Leave], None), None);
        }
        let leaves = Some(RunCommand::Leave);
        assert_eq!(command("Ctrl-C", &[], None), Some(RunCommand::Stop));
        assert_eq!(command("Ctrl-C", &[RunCommand::Leave], None), leaves);
    }
}
