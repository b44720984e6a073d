//! The thread of the live view: reads keys, decides what they mean, and draws the screen.

use std::io;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use ztl_script::event::{Question, RunCommand};

use super::choose::{Chooser, Chosen};
use super::draw::{self, Pane, View};
use super::key_decoder::KeyDecoder;
use super::keys;
use super::rows::Seen;
use super::text::{Capabilities, Line};
use crate::key_press::{KeyPress, LastPress, STALLED};
use crate::{signals, terminal, terminal_mode};
use ztl_script::board::RunBoard;

/// Longest time from an event to its display.
const PAUSE: Duration = Duration::from_millis(40);
/// Interval at which the clocks on the screen advance.
const TICK: Duration = Duration::from_millis(100);
/// This many keys that arrive together are a paste.
const PASTE: usize = 16;
/// What arrives this soon after a part of a paste belongs to it.
const PASTE_GOES_ON: Duration = Duration::from_millis(300);
/// Longest input that is handled at once.
const MOST_INPUT: usize = 64 * 1024;
/// How late keys may be read that are read together.
const LATE: Duration = Duration::from_secs(2);
/// After this time a question that still stands did not accept its answer.
const UNHEARD: Duration = Duration::from_millis(500);

/// What the run and the thread share.
#[derive(Debug)]
pub(super) struct Shared {
    /// Drawing borrows it without the lock, so that the run never waits for that.
    pub(super) board: Arc<RunBoard>,
    /// When the last event was received.
    pub(super) received: Instant,
    pub(super) changed: bool,
    pub(super) over: bool,
}

pub(super) fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The state of the thread.
pub(super) struct Screen {
    shared: Arc<Mutex<Shared>>,
    pressed: Sender<KeyPress>,
    wake: Box<dyn Fn() + Send>,
    capabilities: Capabilities,
    /// Whether the run asks the operator.
    attended: bool,
    decoder: KeyDecoder,
    /// When the last part of a paste was received.
    pasted: Option<Instant>,
    view: View,
    /// What is visible.
    seen: Seen,
    /// Number of the question on the screen.
    shown_question: u64,
    /// The question answered last, and when.
    answered: Option<(u64, Instant)>,
    last_key: Option<(String, LastPress)>,
    /// The lines on the terminal; empty if all must be drawn.
    drawn: Vec<String>,
    size: (usize, usize),
    entered: u32,
    last_drawn: Option<Instant>,
}

impl Screen {
    pub(super) fn new(
        shared: Arc<Mutex<Shared>>,
        pressed: Sender<KeyPress>,
        wake: impl Fn() + Send + 'static,
        capabilities: Capabilities,
        attended: bool,
    ) -> Self {
        Self {
            shared,
            pressed,
            wake: Box::new(wake),
            capabilities,
            attended,
            decoder: KeyDecoder::default(),
            pasted: None,
            view: View::default(),
            seen: Seen::default(),
            shown_question: 0,
            answered: None,
            last_key: None,
            drawn: Vec::new(),
            size: (0, 0),
            entered: 0,
            last_drawn: None,
        }
    }

    pub(super) fn run(mut self) {
        while !lock(&self.shared).over && !terminal_mode::is_restored() {
            match self.turn() {
                Ok(()) => {}
                // Another program on this terminal may have made it non-blocking.
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                    self.drawn.clear();
                    std::thread::sleep(TICK);
                }
                Err(_) => return signals::hang_up(self.attended),
            }
        }
    }

    fn turn(&mut self) -> io::Result<()> {
        // Keys typed before the screen changes were meant for what was visible.
        self.read_keys(Duration::ZERO, false)?;
        self.draw()?;
        self.read_keys(PAUSE, false)
    }

    /// Waits for keys, and handles all that were typed. `unseen`: they were typed before the screen was visible, so
    /// they decide nothing, except for stop keys.
    fn read_keys(&mut self, limit: Duration, unseen: bool) -> io::Result<()> {
        let mut typed = terminal_mode::read_within(limit)?;
        let mut more = !typed.is_empty();
        while more && typed.len() < MOST_INPUT {
            let next = terminal_mode::read_within(Duration::ZERO)?;
            more = !next.is_empty();
            typed.extend(next);
        }
        let now = Instant::now();
        if let Some(key) = self.decoder.given_up(now, &typed) {
            self.handle_keys(vec![key], unseen);
        }
        let keys = self.decoder.complete(now, &typed);
        let goes_on = |at: Instant| now.saturating_duration_since(at) < PASTE_GOES_ON;
        let goes_on = self.pasted.is_some_and(goes_on);
        if !keys.is_empty() && (goes_on || keys.len() >= PASTE) {
            self.pasted = Some(now);
        }
        self.handle_keys(keys, goes_on || unseen);
        Ok(())
    }

    /// Of keys read together, only the first is a decision: the operator has not seen its effect yet. `late`: neither is
    /// the first.
    fn handle_keys(&mut self, keys: Vec<String>, late: bool) {
        let count = keys.len();
        for (nth, key) in keys.into_iter().enumerate() {
            let first = nth == 0 && !late;
            match key.as_str() {
                "Ctrl-Z" => terminal_mode::suspend(),
                "Ctrl-L" => self.drawn.clear(),
                // A stop key always counts, even after other keys.
                name if keys::stops(name) => self.press(key, !first),
                // Moving decides nothing.
                name if self.is_choosing() || keys::scrolls(name) => self.press(key, !first),
                _ if first => self.press(key, count > 1),
                _ => {
                    let press = LastPress::after(None, Instant::now(), Duration::ZERO);
                    self.last_key = Some((key.clone(), press));
                    self.send(key, None, None);
                }
            }
        }
    }

    /// Whether a key is held down, or was pressed twice by mistake. `together`: it was read with others.
    fn is_held(&mut self, key: &str, together: bool) -> bool {
        let late = if together { LATE } else { Duration::ZERO };
        let last = self.last_key.take().filter(|(name, _)| name == key);
        let press = LastPress::after(last.map(|(_, press)| press), Instant::now(), late);
        self.last_key = Some((key.to_owned(), press));
        press.is_repeat() && !self.is_choosing() && !keys::scrolls(key)
    }

    fn press(&mut self, key: String, together: bool) {
        if self.is_held(&key, together) {
            return self.send(key, None, None);
        }
        if self.choose(&key) || self.cue(&key) {
            return;
        }
        let (command, number, question) = {
            let shared = lock(&self.shared);
            let board = &shared.board;
            let (question, number) = (board.question, board.questions);
            let mut choices = board.choices();
            let answered = self
                .answered
                .is_some_and(|(answered, at)| answered == number && at.elapsed() < UNHEARD);
            let fresh = self.shown_question == number && !answered;
            if question.is_some() && !fresh {
                // Only stopping counts for a question that is not visible yet, or was answered.
                choices.clear();
            }
            let can_jump = choices
                .iter()
                .any(|choice| matches!(choice, RunCommand::Jump { .. }));
            let scene = board.scene;
            let command = keys::command(&key, &choices, question);
            drop(shared);
            if command.is_none() && self.look(&key, can_jump, scene) {
                return;
            }
            (command, number, question)
        };
        if command.is_some() {
            self.view = View::default();
        }
        if command.is_some_and(|command| !matches!(command, RunCommand::Pause | RunCommand::Resume))
        {
            self.answered = Some((number, Instant::now()));
        }
        self.send(key, command, question);
    }

    fn send(&self, key: String, command: Option<RunCommand>, question: Option<Question>) {
        self.pass(KeyPress {
            key,
            command,
            cue: None,
            question,
        });
    }

    fn pass(&self, press: KeyPress) {
        // The operator who pressed this key has seen the notes on the screen.
        if !self.seen.notes.is_empty() {
            let mut shared = lock(&self.shared);
            Arc::make_mut(&mut shared.board).see_notes(&self.seen.notes);
        }
        // Fails only when the run is over.
        let _ = self.pressed.send(press);
        (self.wake)();
    }

    const fn is_choosing(&self) -> bool {
        matches!(self.view.pane, Pane::Choose(_))
    }

    /// Changes the view if the key does so. This is not a decision and is not recorded.
    fn look(&mut self, key: &str, can_jump: bool, scene: Option<usize>) -> bool {
        let page = self.seen.height.saturating_sub(1).max(1);
        let from = self.seen.from;
        let toggled = |pane: &Pane, other: Pane| match *pane == other {
            true => View::default(),
            false => View::of(other),
        };
        self.view = match key {
            "?" => toggled(&self.view.pane, Pane::Keys),
            "d" | "D" => toggled(&self.view.pane, Pane::Details),
            "k" | "K" if lock(&self.shared).board.has_cues() => {
                toggled(&self.view.pane, Pane::Cues)
            }
            "j" | "J" if can_jump => View::of(Pane::Choose(Chooser::at(scene.unwrap_or(0)))),
            "Esc" if self.view != View::default() => View::default(),
            key if keys::scrolls(key) => {
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
        self.last_drawn = None;
        true
    }

    /// Passes a key to the chooser, if it is open. Keys that stop come first.
    fn choose(&mut self, key: &str) -> bool {
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
        let chosen = chooser.press(key, &board.outline.scenes, self.seen.height);
        drop(shared);
        self.last_drawn = None;
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
        self.send(format!("j{typed} {key}"), command, question);
        true
    }

    /// Passes the key of a cue on. On the page of cues, other letters mean nothing, except for those that stop.
    fn cue(&mut self, key: &str) -> bool {
        let on_page = self.view.pane == Pane::Cues;
        let cue = keys::cue(key, &lock(&self.shared).board.outline.cues, on_page);
        let is_letter = key.chars().count() == 1 && key.chars().all(char::is_alphanumeric);
        let means_nothing = on_page && is_letter && !keys::stops(key) && !matches!(key, "k" | "K");
        if cue.is_none() && !means_nothing {
            return false;
        }
        if cue.is_some() {
            self.view = View::default();
            self.last_drawn = None;
        }
        let key = if on_page {
            format!("k {key}")
        } else {
            key.to_owned()
        };
        self.pass(KeyPress {
            key,
            command: None,
            cue,
            question: None,
        });
        true
    }

    fn draw(&mut self) -> io::Result<()> {
        let size = terminal::size();
        let entered = terminal_mode::times_entered();
        let all = entered != self.entered || size != self.size || self.drawn.is_empty();
        let due = self.last_drawn.is_none_or(|last| last.elapsed() >= TICK);
        let (board, received) = {
            let mut shared = lock(&self.shared);
            if !(all || due || shared.changed) {
                return Ok(());
            }
            shared.changed = false;
            (Arc::clone(&shared.board), shared.received)
        };
        if board.question.is_none() && self.is_choosing() || self.shown_question != board.questions
        {
            // A new question is always visible, and closes the chooser of the one before.
            self.view = View::default();
        }
        let question = board.questions;
        let now = match board.ended {
            Some(_) => board.at,
            None => board.at + received.elapsed(),
        };
        let (lines, seen) = draw::draw(&board, &self.view, now, size);
        drop(board);
        self.last_drawn = Some(Instant::now());
        if all {
            self.drawn.clear();
            self.size = size;
            self.entered = entered;
        }
        let out = self.update(&lines);
        let before = Instant::now();
        if !out.is_empty() && !terminal_mode::is_restored() {
            terminal_mode::write(out.as_bytes())?;
        }
        if question != self.shown_question && before.elapsed() > STALLED {
            self.read_keys(Duration::ZERO, true)?;
        }
        self.shown_question = question;
        self.seen = seen;
        Ok(())
    }

    /// Replaces the drawn lines; returns what changes them on the terminal.
    fn update(&mut self, lines: &[Line]) -> String {
        let mut out = String::new();
        if self.drawn.is_empty() {
            out.push_str("\x1b[0m\x1b[2J");
        }
        let encoded = lines.iter().map(|line| line.encoded(self.capabilities));
        let lines: Vec<String> = encoded.collect();
        for (nth, line) in lines.iter().enumerate() {
            if self.drawn.get(nth) != Some(line) {
                out.push_str(&format!("\x1b[{};1H\x1b[2K{line}", nth + 1));
            }
        }
        self.drawn = lines;
        out
    }
}
