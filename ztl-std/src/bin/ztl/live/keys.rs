//! What keys mean.

use ztl_std::script::event::{Command, Question};

use super::board::Board;

/// What a key means among what can be wanted.
pub(super) fn command(
    key: &str,
    choices: &[Command],
    question: Option<Question>,
) -> Option<Command> {
    let wanted = match key {
        "Enter" => Command::Start,
        "s" | "S" => Command::Skip,
        "r" | "R" => Command::Replay,
        "a" | "A" => Command::Restart,
        "p" | "P" if choices.contains(&Command::Resume) => Command::Resume,
        "p" | "P" => Command::Pause,
        "t" | "T" => Command::Retry,
        "g" | "G" => Command::GoOn,
        // The second time leaves, whatever still runs.
        "x" | "X" | "Ctrl-C" if choices == [Command::Leave] => Command::Leave,
        // Works at any time.
        "x" | "X" | "Ctrl-C" => return Some(Command::Stop),
        "q" | "Q" if may_leave(question) => Command::Leave,
        _ => return None,
    };
    choices.contains(&wanted).then_some(wanted)
}

/// In the middle of a step leaving would let a robot move on with nobody there: there is only stopping.
const fn may_leave(question: Option<Question>) -> bool {
    matches!(question, Some(Question::Scene { .. } | Question::End))
}

/// Keys that can be pressed now, and what they do: for the lines that always show them.
pub(super) fn help(board: &Board) -> Vec<(&'static str, String)> {
    let choices = board.choices();
    let question = board.question;
    let mut keys = Vec::new();
    let mut offer = |key, command, words: &str| {
        if choices.contains(&command) {
            keys.push((key, words.to_owned()));
        }
    };
    offer("Enter", Command::Start, "start");
    offer(
        "s",
        Command::Skip,
        match question {
            Some(Question::Scene { .. }) => "skip",
            _ => "skip the rest of the scene",
        },
    );
    offer("r", Command::Replay, "replay last");
    offer("t", Command::Retry, "retry what failed");
    offer("g", Command::GoOn, "go on anyway");
    match (question, board.pause) {
        (Some(Question::Pause), _) => offer("p", Command::Resume, "go on"),
        (_, true) => offer("p", Command::Resume, "no pause after this step"),
        _ => offer("p", Command::Pause, "pause after this step"),
    }
    offer("a", Command::Restart, "begin again");
    if choices
        .iter()
        .any(|choice| matches!(choice, Command::Jump { .. }))
    {
        keys.push(("j", "jump to a scene".to_owned()));
    }
    if may_leave(question) && choices.contains(&Command::Leave) {
        let words = match board.in_background().count() {
            0 => "leave".to_owned(),
            1 => "leave (1 task runs on)".to_owned(),
            tasks => format!("leave ({tasks} tasks run on)"),
        };
        keys.push(("q", words));
    }
    if choices == [Command::Leave] {
        keys.push(("Ctrl-C", "leave without waiting".to_owned()));
    } else if board.ended.is_none() {
        keys.push(("x", "stop everything".to_owned()));
    }
    keys
}

/// Choosing a scene to jump to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Chooser {
    pub(super) cursor: usize,
}

/// What a key did to the chooser.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Chosen {
    Stay(Chooser),
    Scene(usize),
    Nothing,
}

impl Chooser {
    pub(super) fn press(self, key: &str, scenes: usize) -> Chosen {
        let last = scenes.saturating_sub(1);
        let to = |cursor: usize| {
            Chosen::Stay(Self {
                cursor: cursor.min(last),
            })
        };
        match key {
            "Up" | "k" => to(self.cursor.saturating_sub(1)),
            "Down" | "j" => to(self.cursor + 1),
            "Home" => to(0),
            "End" => to(last),
            "Enter" => Chosen::Scene(self.cursor.min(last)),
            digit => match digit.parse::<usize>() {
                Ok(digit @ 1..) if digit <= scenes => Chosen::Scene(digit - 1),
                _ => Chosen::Nothing,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_can_be_wanted_is_meant() {
        let at_scene = Some(Question::Scene { scene: 0 });
        let choices = [Command::Start, Command::Skip, Command::Leave];
        assert_eq!(command("Enter", &choices, at_scene), Some(Command::Start));
        assert_eq!(command("r", &choices, at_scene), None);
        assert_eq!(command("q", &choices, at_scene), Some(Command::Leave));
        let at_step = Some(Question::Step { scene: 0, step: 0 });
        assert_eq!(command("q", &choices, at_step), None, "the robot may move");
        for key in ["x", "Ctrl-C"] {
            assert_eq!(command(key, &[], None), Some(Command::Stop));
            assert_eq!(command(key, &[Command::Leave], None), Some(Command::Leave));
        }
    }

    #[test]
    fn a_scene_is_chosen_by_its_number_or_by_moving_to_it() {
        let at = |cursor| Chooser { cursor };
        assert_eq!(at(0).press("3", 4), Chosen::Scene(2));
        assert_eq!(at(0).press("5", 4), Chosen::Nothing);
        assert_eq!(at(3).press("Down", 4), Chosen::Stay(at(3)));
        assert_eq!(at(3).press("Up", 4), Chosen::Stay(at(2)));
        assert_eq!(at(2).press("Enter", 4), Chosen::Scene(2));
        assert_eq!(at(2).press("Esc", 4), Chosen::Nothing);
    }
}
