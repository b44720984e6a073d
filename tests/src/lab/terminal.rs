//! A terminal in which a program runs: tests type keys and read its screen.

use std::fs::File;
use std::io::{Read, Write};
use std::num::NonZero;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::process::{Child, Command, ExitStatus};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, poll};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{Action, LocalModes, Termios, Winsize, tcflow, tcgetattr, tcsetwinsize};

use super::process::signal;
use super::{PATIENCE, until};

/// A program in its own terminal. It is killed when this is dropped.
pub struct Terminal {
    name: String,
    child: Child,
    /// `None` when the window was closed.
    window: Option<Window>,
    /// Held open, so that the terminal outlives the program and can be looked at.
    tty: OwnedFd,
    screen: Arc<Mutex<vt100::Parser>>,
}

/// The end of the pty that a terminal emulator holds.
struct Window {
    keys: File,
    /// Reads the output until `stop` is dropped.
    reader: JoinHandle<()>,
    stop: UnixStream,
}

impl Terminal {
    /// Starts a program in a terminal of so many columns and lines.
    #[track_caller]
    pub fn start(command: &Command, size: (u16, u16)) -> Self {
        let master =
            openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).expect("a pty");
        grantpt(&master)
            .and_then(|()| unlockpt(&master))
            .expect("its other end");
        let path = ptsname(&master, Vec::new())
            .expect("its name")
            .into_string()
            .unwrap();
        // Opening it must not make it the controlling terminal of this process.
        let open = || {
            let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY;
            rustix::fs::open(path.as_str(), flags, rustix::fs::Mode::empty()).expect("a terminal")
        };
        let tty = open();
        set_size(&tty, size);
        // The terminal becomes that of a session of the program alone, as a window's is.
        let mut started = Command::new("setsid");
        started
            .arg("--ctty")
            .arg(command.get_program())
            .args(command.get_args());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => started.env(name, value),
                None => started.env_remove(name),
            };
        }
        if let Some(directory) = command.get_current_dir() {
            started.current_dir(directory);
        }
        if !command.get_envs().any(|(name, _)| name == "TERM") {
            started.env("TERM", "xterm");
        }
        started.stdin(open()).stdout(open()).stderr(open());
        let name = format!("{command:?}");
        let child = started
            .spawn()
            .unwrap_or_else(|error| panic!("cannot start {name}: {error}"));
        let screen = Arc::new(Mutex::new(vt100::Parser::new(
            some(size.1),
            some(size.0),
            500,
        )));
        Self {
            name,
            child,
            window: Some(Window::open(File::from(master), Arc::clone(&screen))),
            tty,
            screen,
        }
    }

    /// Closes the window, so that the program's terminal is gone.
    pub fn vanish(&mut self) {
        let window = self.window.take().expect("a window");
        drop(window.stop);
        window.reader.join().expect("the reader");
    }

    /// Types these bytes, all at once.
    #[track_caller]
    pub fn type_in(&mut self, keys: impl AsRef<[u8]>) {
        let window = self.window.as_mut().expect("a window");
        window.keys.write_all(keys.as_ref()).expect("a terminal");
    }

    /// The lines on the screen, without trailing blanks.
    pub fn screen(&self) -> String {
        let parser = self.screen.lock().unwrap();
        let (_, width) = parser.screen().size();
        let lines: Vec<String> = parser
            .screen()
            .rows(0, width.get())
            .map(|row| row.trim_end().to_owned())
            .collect();
        lines.join("\n")
    }

    /// Waits until the screen shows this; gives the whole.
    #[track_caller]
    pub fn shows(&self, part: &str) -> String {
        self.shows_that(part, |screen| screen.contains(part))
    }

    /// Waits until the screen has the expected content.
    #[track_caller]
    pub fn shows_that(&self, what: &str, is: impl Fn(&str) -> bool) -> String {
        let start = Instant::now();
        loop {
            let screen = self.screen();
            if is(&screen) {
                return screen;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "never '{what}' from {}:\n{screen}\n---",
                self.name
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Whether the program uses the alternate screen, which hides the shell's output.
    pub fn is_full_screen(&self) -> bool {
        self.screen.lock().unwrap().screen().alternate_screen()
    }

    /// Whether the cursor is visible.
    pub fn has_cursor(&self) -> bool {
        !self.screen.lock().unwrap().screen().hide_cursor()
    }

    /// Whether any text on the screen has a colour.
    pub fn has_colour(&self) -> bool {
        let parser = self.screen.lock().unwrap();
        let screen = parser.screen();
        let (height, width) = screen.size();
        let cells =
            (0..height.get()).flat_map(|row| (0..width.get()).map(move |column| (row, column)));
        cells
            .filter_map(|(row, column)| screen.cell(row, column))
            .any(|cell| {
                cell.fgcolor() != vt100::Color::Default || cell.bgcolor() != vt100::Color::Default
            })
    }

    /// Its input modes.
    pub fn modes(&self) -> Termios {
        tcgetattr(&self.tty).expect("a terminal")
    }

    /// Whether it echoes input and waits for whole lines, as a shell expects.
    pub fn is_as_before(&self) -> bool {
        let lines = LocalModes::ICANON | LocalModes::ECHO | LocalModes::ISIG;
        self.modes().local_modes.contains(lines) && !self.is_full_screen() && self.has_cursor()
    }

    /// Waits until it is so.
    #[track_caller]
    pub fn waits_until_as_before(&self) {
        until("a terminal as it was before", PATIENCE, || {
            self.is_as_before().then_some(())
        });
    }

    /// Stalls the output, as a connection does that is lost for a while, or lets it go on.
    pub fn stall(&self, is_stalled: bool) {
        let action = match is_stalled {
            true => Action::OOff,
            false => Action::OOn,
        };
        tcflow(&self.tty, action).expect("a terminal");
    }

    /// Somebody makes the window larger or smaller.
    pub fn resize(&mut self, size: (u16, u16)) {
        set_size(&self.tty, size);
        self.screen
            .lock()
            .unwrap()
            .screen_mut()
            .set_size(some(size.1), some(size.0));
    }

    /// The program's number in the system.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal by name: `TERM`, `HUP`.
    #[track_caller]
    pub fn signal(&self, name: &str) {
        signal(self.id(), name);
    }

    /// Waits for the program's end.
    #[track_caller]
    pub fn end(&mut self) -> ExitStatus {
        let start = Instant::now();
        loop {
            if let Some(status) = self.child.try_wait().expect("its status") {
                return status;
            }
            let screen = self.screen();
            assert!(
                start.elapsed() < PATIENCE,
                "{} does not end:\n{screen}\n---",
                self.name
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Window {
    fn open(master: File, screen: Arc<Mutex<vt100::Parser>>) -> Self {
        let (stop, stopped) = UnixStream::pair().expect("a socket pair");
        let mut output = master.try_clone().expect("its output");
        let reader = std::thread::spawn(move || {
            let mut bytes = [0; 4096];
            loop {
                let mut ready = [
                    PollFd::new(&output, PollFlags::IN),
                    PollFd::new(&stopped, PollFlags::IN),
                ];
                if poll(&mut ready, None).is_err() || !ready[1].revents().is_empty() {
                    return;
                }
                let Ok(count @ 1..) = output.read(&mut bytes) else {
                    return;
                };
                screen.lock().unwrap().process(&bytes[..count]);
            }
        });
        Self {
            keys: master,
            reader,
            stop,
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn set_size(tty: &OwnedFd, (columns, lines): (u16, u16)) {
    let size = Winsize {
        ws_row: lines,
        ws_col: columns,
        ws_xpixel: 0,
        ws_ypixel: 0,
    };
    tcsetwinsize(tty, size).expect("a terminal");
}

fn some(count: u16) -> NonZero<u16> {
    NonZero::new(count).expect("a terminal of some size")
}
