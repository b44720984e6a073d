//! Keys that decide nothing: looking around, pages, and choosing a scene to jump to.

use std::time::Instant;

use ztl_script::event::RunCommand;

use super::choose::{Chooser, Chosen};
use super::draw::{Pane, View};
use super::{Screen, lock};

/// Whether a key stops something, or everything.
pub(super) fn stops(key: &str) -> bool {
    matches!(key, "Ctrl-C" | "Ctrl-X" | "c" | "C" | "x" | "X")
}

/// Whether a key moves what is looked at.
pub(super) fn scrolls(key: &str) -> bool {
    matches!(key, "Up" | "Down" | "PageUp" | "PageDown" | "Home" | "End")
}

impl Screen {
    pub(super) const fn is_choosing(&self) -> bool {
        matches!(self.view.pane, Pane::Choose(_))
    }

    /// Looks at something else, if that is what the key is for. It is no decision, and not recorded.
    pub(super) fn look(&mut self, key: &str, jumps: bool, scene: Option<usize>) -> bool {
        let page = self.body.height.saturating_sub(1).max(1);
        let from = self.body.from;
        let toggled = |pane: &Pane, other: Pane| match *pane == other {
            true => View::default(),
            false => View {
                pane: other,
                top: None,
            },
        };
        let view = match key {
            "?" => toggled(&self.view.pane, Pane::Keys),
            "d" | "D" => toggled(&self.view.pane, Pane::Details),
            "j" | "J" if jumps => View {
                pane: Pane::Choose(Chooser::at(scene.unwrap_or(0))),
                top: None,
            },
            "Esc" if self.view != View::default() => View::default(),
            key if scrolls(key) => {
                let top = match key {
                    "Up" => from.saturating_sub(1),
                    "Down" => from + 1,
                    "PageUp" => from.saturating_sub(page),
                    "PageDown" => from + page,
                    "Home" => 0,
                    _ => usize::MAX,
                };
                View {
                    pane: self.view.pane.clone(),
                    top: Some(top),
                }
            }
            _ => return false,
        };
        self.view = view;
        self.last = None;
        true
    }

    /// Takes a key for choosing a scene, if one is chosen; but stopping comes first.
    pub(super) fn choose(&mut self, key: &str) -> bool {
        let Pane::Choose(chooser) = &mut self.view.pane else {
            return false;
        };
        if matches!(key, "Ctrl-C" | "Ctrl-X") {
            return false;
        }
        let shared = lock(&self.shared);
        let board = &shared.board;
        let (question, number) = (board.question, board.questions);
        let typed = match chooser.typed.as_str() {
            "" => String::new(),
            typed => format!(" {typed}"),
        };
        let chosen = chooser.press(key, &board.outline.scenes, self.body.height);
        drop(shared);
        self.last = None;
        let command = match chosen {
            Chosen::Stay => return true,
            Chosen::Nothing if key == "Esc" => {
                self.view = View::default();
                return true;
            }
            Chosen::Nothing => None,
            Chosen::Scene(scene) => Some(RunCommand::Jump { scene }),
        };
        self.view = View::default();
        if command.is_some() {
            self.answered = Some((number, Instant::now()));
        }
        self.tell(format!("j{typed} {key}"), command, question);
        true
    }
}
