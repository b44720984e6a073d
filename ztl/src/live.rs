//! The live view of a show: a screen that a thread of its own draws, and the keys that it reads.
//!
//! The show never waits for the terminal: it only says what happened ([`Live::handle`]), and asks
//! what was pressed ([`Live::pressed`]).

mod board;
mod choose;
mod draw;
mod keys;
mod look;
mod message;
mod rows;
mod text;
pub(crate) mod tty;

use std::io;
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use ztl_script::event::{Question, RunCommand, StampedEvent};

use self::board::Board;
use self::draw::View;
use self::look::{scrolls, stops};
use self::rows::Seen;
use self::text::Line;
use crate::key_name::{self, FIRST_REPEAT, HELD, Pressed};
use crate::terminal::drawn_line;

/// Longest time between something happening and its being seen.
const PAUSE: Duration = Duration::from_millis(40);
/// How often the clocks on the screen go on.
const TICK: Duration = Duration::from_millis(100);
/// How long the rest of a key's bytes is waited for.
const REST: Duration = Duration::from_millis(40);
/// The same when several came at once, so that they were read late.
const LATE: Duration = Duration::from_secs(2);
/// When a question still stands so long after its answer, that was not taken.
const UNHEARD: Duration = Duration::from_millis(500);

/// The view; the terminal is given back when it is dropped.
#[derive(Debug)]
pub(crate) struct Live {
    shared: Arc<Mutex<Shared>>,
    pressed: Receiver<Pressed>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Debug)]
struct Shared {
    board: Board,
    /// When its last event came, to tell the time of the run.
    came: Instant,
    changed: bool,
    over: bool,
}

impl Live {
    /// Takes the terminal. `wake` is called whenever a key was pressed.
    ///
    /// # Errors
    /// When the terminal cannot be taken; it is then as it was.
    pub(crate) fn open(wake: impl Fn() + Send + 'static) -> io::Result<Self> {
        tty::take()?;
        let shared = Arc::new(Mutex::new(Shared {
            board: Board::default(),
            came: Instant::now(),
            changed: true,
            over: false,
        }));
        let (sender, pressed) = mpsc::channel();
        let screen = Screen {
            shared: Arc::clone(&shared),
            pressed: sender,
            wake: Box::new(wake),
            view: View::default(),
            body: Seen::default(),
            seen: 0,
            answered: None,
            key: None,
            drawn: Vec::new(),
            size: (0, 0),
            taken: 0,
            last: None,
            colour: has_colour(),
            ascii: !speaks_utf8(),
        };
        let thread = std::thread::Builder::new()
            .name("ztl-live".to_owned())
            .spawn(move || screen.run());
        let thread = thread.inspect_err(|_| tty::restore())?;
        Ok(Self {
            shared,
            pressed,
            thread: Some(thread),
        })
    }

    /// Something has happened; it is shown soon.
    pub(crate) fn handle(&self, event: &StampedEvent) {
        let mut shared = lock(&self.shared);
        shared.board.handle(event);
        shared.came = Instant::now();
        shared.changed = true;
    }

    /// The next key that was pressed, if any was.
    pub(crate) fn pressed(&self) -> Option<Pressed> {
        self.pressed.try_recv().ok()
    }
}

impl Live {
    /// Gives the terminal back, and leaves on it how it went.
    pub(crate) fn close(mut self) {
        self.end();
        let (colour, ascii) = (has_colour(), !speaks_utf8());
        let (width, _) = tty::size();
        for text in draw::summary(&lock(&self.shared).board, width) {
            drawn_line(&text.encoded(colour, ascii));
        }
    }

    fn end(&mut self) {
        lock(&self.shared).over = true;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        tty::restore();
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.end();
    }
}

/// Whether colours are wanted (`NO_COLOR`).
fn has_colour() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty())
}

fn lock(shared: &Mutex<Shared>) -> MutexGuard<'_, Shared> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whether the terminal shows more than ASCII, by what the locale says.
fn speaks_utf8() -> bool {
    let set = ["LC_ALL", "LC_CTYPE", "LANG"]
        .into_iter()
        .filter_map(|name| std::env::var(name).ok())
        .find(|value| !value.is_empty());
    set.is_some_and(|locale| {
        let locale = locale.to_ascii_lowercase();
        locale.contains("utf-8") || locale.contains("utf8")
    })
}

/// A key that was pressed.
struct Last {
    key: String,
    at: Instant,
    /// It was held down.
    again: bool,
}

impl Last {
    fn new(key: &str) -> Self {
        Self {
            key: key.to_owned(),
            at: Instant::now(),
            again: false,
        }
    }

    /// When the same key comes again sooner than this, it is held down.
    const fn limit(&self) -> Duration {
        match self.again {
            true => HELD,
            false => FIRST_REPEAT,
        }
    }
}

/// What the thread has.
struct Screen {
    shared: Arc<Mutex<Shared>>,
    pressed: Sender<Pressed>,
    wake: Box<dyn Fn() + Send>,
    view: View,
    /// What was seen of the middle of the screen.
    body: Seen,
    /// The question that is on the screen, by its number; 0: none.
    seen: u64,
    /// The question that was answered last, and when.
    answered: Option<(u64, Instant)>,
    /// The last key.
    key: Option<Last>,
    drawn: Vec<String>,
    size: (usize, usize),
    taken: u32,
    last: Option<Instant>,
    colour: bool,
    ascii: bool,
}

impl Screen {
    fn run(mut self) {
        loop {
            if lock(&self.shared).over || tty::is_closed() {
                return;
            }
            if self.turn().is_err() {
                // Nobody sees anything any more. That is told by a signal; the show goes on.
                std::thread::sleep(TICK);
            }
        }
    }

    fn turn(&mut self) -> io::Result<()> {
        // What was typed before the screen changes was meant for what was seen.
        let typed = self.read(Duration::ZERO)?;
        self.type_in(&typed);
        self.draw()?;
        let typed = self.read(PAUSE)?;
        self.type_in(&typed);
        Ok(())
    }

    /// What was typed, with the rest of a key whose bytes come in pieces.
    fn read(&mut self, limit: Duration) -> io::Result<Vec<u8>> {
        let mut typed = tty::read(limit)?;
        let mut at = 0;
        while at < typed.len() {
            match key_name::first(typed.get(at..).unwrap_or_default()) {
                Some((_, length)) => at += length,
                None => {
                    let rest = tty::read(REST)?;
                    if rest.is_empty() {
                        break;
                    }
                    typed.extend(rest);
                }
            }
        }
        Ok(typed)
    }

    /// Only the first of what came at once is a decision: a person has not seen what it led to.
    fn type_in(&mut self, typed: &[u8]) {
        let mut rest = typed;
        let mut nth = 0;
        while !rest.is_empty() {
            let (key, length) = key_name::first(rest).unwrap_or_else(|| match rest {
                [0x1b] => ("Esc".to_owned(), 1),
                _ => ("?".to_owned(), rest.len()),
            });
            rest = rest.get(length..).unwrap_or_default();
            match key.as_str() {
                // No key of the show: the whole program is stopped, as in any other.
                "Ctrl-Z" => tty::suspend(),
                "Ctrl-L" => self.drawn.clear(),
                // Whatever came before it: whoever wants to stop must not be unheard.
                name if stops(name) => self.press(key, nth > 0),
                // Where these lead is shown before anything is played.
                name if self.is_choosing() || scrolls(name) => self.press(key, nth > 0),
                _ if nth == 0 => self.press(key, !rest.is_empty()),
                _ => {
                    self.key = Some(Last::new(&key));
                    self.tell(key, None, None);
                }
            }
            nth += 1;
        }
    }

    /// Whether a key is held down, or came twice by a slip. Moving is no harm then.
    /// `several`: it came with others at once, so this is late in reading it.
    fn is_held(&mut self, key: &str, several: bool) -> bool {
        let mut last = Last::new(key);
        let before = self.key.take();
        let limit = before.as_ref().map_or(HELD, Last::limit);
        let limit = if several { LATE } else { limit };
        last.again = before.is_some_and(|before| before.key == key && last.at - before.at < limit);
        let moves = self.is_choosing() || scrolls(key);
        let held = last.again && !moves;
        self.key = Some(last);
        held
    }

    fn press(&mut self, key: String, several: bool) {
        if self.is_held(&key, several) {
            return self.tell(key, None, None);
        }
        if self.choose(&key) {
            return;
        }
        let (command, current, question) = {
            let shared = lock(&self.shared);
            let board = &shared.board;
            let question = board.question;
            let mut choices = board.choices();
            // What is asked is not what was seen, or was answered before: only stopping counts.
            let number = board.questions;
            let answered = self
                .answered
                .is_some_and(|(answered, at)| answered == number && at.elapsed() < UNHEARD);
            let fresh = self.seen == number && !answered;
            if question.is_some() && !fresh {
                choices.clear();
            }
            let jumps = choices
                .iter()
                .any(|choice| matches!(choice, RunCommand::Jump { .. }));
            let scene = board.scene;
            let command = keys::command(&key, &choices, question);
            drop(shared);
            if command.is_none() && self.look(&key, jumps, scene) {
                return;
            }
            (command, number, question)
        };
        if command.is_some() {
            self.view = View::default();
        }
        if command.is_some_and(|command| !matches!(command, RunCommand::Pause | RunCommand::Resume))
        {
            self.answered = Some((current, Instant::now()));
        }
        self.tell(key, command, question);
    }

    fn tell(&self, key: String, command: Option<RunCommand>, question: Option<Question>) {
        // Without a show there is nothing to be done.
        let _ = self.pressed.send(Pressed {
            key,
            command,
            question,
        });
        (self.wake)();
    }

    fn draw(&mut self) -> io::Result<()> {
        let size = tty::size();
        let taken = tty::taken();
        let again = taken != self.taken || size != self.size || self.drawn.is_empty();
        let due = self.last.is_none_or(|last| last.elapsed() >= TICK);
        let lines = {
            let mut shared = lock(&self.shared);
            if !(again || due || shared.changed) {
                return Ok(());
            }
            shared.changed = false;
            let board = &shared.board;
            if board.question.is_none() && self.is_choosing() || self.seen != board.questions {
                // What happens is seen, and a question that settled itself takes its chooser with it.
                self.view = View::default();
            }
            self.seen = board.questions;
            let now = match board.ended {
                Some(_) => board.at,
                None => board.at + shared.came.elapsed(),
            };
            let (lines, seen) = draw::draw(board, &self.view, now, size);
            self.body = seen;
            lines
        };
        self.last = Some(Instant::now());
        if again {
            self.drawn.clear();
            self.size = size;
            self.taken = taken;
        }
        let (out, drawn) = difference(&self.drawn, &lines, self.colour, self.ascii);
        self.drawn = drawn;
        if out.is_empty() || tty::is_closed() {
            return Ok(());
        }
        tty::write(out.as_bytes())
    }
}

/// What a terminal has to be told, to show these lines in place of those.
fn difference(
    drawn: &[String],
    lines: &[Line],
    colour: bool,
    ascii: bool,
) -> (String, Vec<String>) {
    let mut out = String::new();
    if drawn.is_empty() {
        out.push_str("\x1b[0m\x1b[2J");
    }
    let lines: Vec<String> = lines
        .iter()
        .map(|line| line.encoded(colour, ascii))
        .collect();
    for (nth, line) in lines.iter().enumerate() {
        if drawn.get(nth) != Some(line) {
            out.push_str(&format!("\x1b[{};1H\x1b[2K{line}", nth + 1));
        }
    }
    (out, lines)
}
