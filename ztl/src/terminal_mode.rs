//! The mode of the terminal: taken for single keys or for a full screen, and restored however the process
//! ends.
//!
//! crossterm 0.29 does not replace this: its reader never returns when the terminal is gone, blocks while a key is
//! incomplete, and reads an arrow key whose bytes arrive separately as three keys, one of them `C`.

use std::io::{self, Write};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::termios::{
    InputModes, LocalModes, OptionalActions, QueueSelector, SpecialCodeIndex, Termios, tcflush,
    tcgetattr, tcgetpgrp, tcsetattr,
};
use signal_hook::consts::{SIGCONT, SIGQUIT, SIGTSTP};
use signal_hook::low_level::emulate_default_handler;

/// What the terminal is taken for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mode {
    /// Single keys, without echo. Ctrl-C stays a signal.
    Keys,
    /// Single keys, Ctrl-C among them, and the alternate screen without a cursor.
    Screen,
}

#[derive(Debug)]
struct Terminal {
    /// `None` while it is not taken, or once it was restored for good.
    mode: Option<Mode>,
    /// The settings to restore; `None` while they are in force.
    saved: Option<Termios>,
    /// Counts how often the screen was entered.
    entered: u32,
}

static TERMINAL: Mutex<Terminal> = Mutex::new(Terminal {
    mode: None,
    saved: None,
    entered: 0,
});

/// Without auto-wrap (`?7`), so that a text that the terminal shows wider than expected covers no other line.
const ENTER_SCREEN: &str = "\x1b[?1049h\x1b[?7l\x1b[?25l\x1b[2J";
const LEAVE_SCREEN: &str = "\x1b[0m\x1b[2J\x1b[?25h\x1b[?1049l\x1b[?7h";

/// The character code that disables a special key.
const DISABLED: u8 = if cfg!(any(target_os = "linux", target_os = "android")) {
    0
} else {
    0xff
};

/// Takes the terminal until [`restore`]. A panic and SIGQUIT restore it; SIGTSTP restores it until the process
/// continues.
///
/// # Errors
/// If stdin is not a terminal.
pub(crate) fn take(mode: Mode) -> io::Result<()> {
    static HOOKS: Once = Once::new();
    terminal().mode = Some(mode);
    let taken = terminal().enter();
    let mut watched = Ok(());
    HOOKS.call_once(|| {
        let report = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            report(panic);
        }));
        watched = watch_signals();
    });
    taken.and(watched).inspect_err(|_| restore())
}

/// Restores the terminal for good. Any thread may call it, any number of times.
pub(crate) fn restore() {
    let mut terminal = terminal();
    terminal.leave();
    terminal.mode = None;
}

/// Whether the terminal is no longer taken.
pub(crate) fn is_restored() -> bool {
    terminal().mode.is_none()
}

/// Changes when the screen has to be drawn as a whole.
pub(crate) fn times_entered() -> u32 {
    terminal().entered
}

/// Restores the terminal, stops the process as Ctrl-Z does, and takes the terminal again when the process
/// continues.
pub(crate) fn suspend() {
    terminal().leave();
    let _ = emulate_default_handler(SIGTSTP);
    resume();
}

fn terminal() -> MutexGuard<'static, Terminal> {
    TERMINAL.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Terminal {
    fn enter(&mut self) -> io::Result<()> {
        let Some(mode) = self.mode else { return Ok(()) };
        if self.saved.is_none() {
            let saved = tcgetattr(io::stdin())?;
            // Drops keys typed ahead.
            tcsetattr(io::stdin(), OptionalActions::Flush, &mode.settings(&saved))?;
            self.saved = Some(saved);
        }
        if mode == Mode::Screen {
            write(ENTER_SCREEN.as_bytes())?;
            self.entered += 1;
        }
        Ok(())
    }

    /// Whether the terminal still has the settings of `enter`.
    fn is_set(&self) -> bool {
        let ours = self.mode.zip(self.saved.as_ref());
        let ours = ours.map(|(mode, saved)| mode.settings(saved));
        ours.zip(tcgetattr(io::stdin()).ok())
            .is_some_and(|(ours, now)| {
                (ours.local_modes, ours.input_modes) == (now.local_modes, now.input_modes)
            })
    }

    fn leave(&mut self) {
        let Some(saved) = self.saved.take() else {
            return;
        };
        // Errors mean that the terminal is gone.
        if self.mode == Some(Mode::Screen) {
            let _ = write(LEAVE_SCREEN.as_bytes());
        }
        // `OptionalActions::Flush` would wait for the output, which may be stalled.
        drop_input();
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &saved);
    }
}

impl Mode {
    fn settings(self, saved: &Termios) -> Termios {
        let mut settings = saved.clone();
        match self {
            Self::Screen => settings.make_raw(),
            Self::Keys => {
                settings.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
                // Tells Enter from Ctrl-J.
                settings.input_modes -= InputModes::ICRNL | InputModes::INLCR;
                settings.special_codes[SpecialCodeIndex::VSUSP] = DISABLED;
                settings.special_codes[SpecialCodeIndex::VQUIT] = DISABLED;
                settings.special_codes[SpecialCodeIndex::VMIN] = 1;
                settings.special_codes[SpecialCodeIndex::VTIME] = 0;
            }
        }
        settings
    }
}

/// Takes the terminal again if this process may use it. The shell may have changed its settings.
fn resume() {
    let mut terminal = terminal();
    let foreground = tcgetpgrp(io::stdin()).is_ok_and(|group| group == rustix::process::getpgrp());
    if terminal.mode.is_none() || !foreground {
        return;
    }
    // Setting them again would drop keys that were pressed meanwhile.
    if !terminal.is_set()
        && let Some(saved) = terminal.saved.take()
    {
        let _ = tcsetattr(io::stdin(), OptionalActions::Now, &saved);
    }
    let _ = terminal.enter();
}

fn watch_signals() -> io::Result<()> {
    let mut signals = signal_hook::iterator::Signals::new([SIGTSTP, SIGCONT, SIGQUIT])?;
    std::thread::Builder::new()
        .name("ztl-terminal".to_owned())
        .spawn(move || {
            for signal in signals.forever() {
                match signal {
                    SIGTSTP => suspend(),
                    SIGCONT => resume(),
                    _ => {
                        restore();
                        let _ = emulate_default_handler(signal);
                    }
                }
            }
        })?;
    Ok(())
}

/// Drops the unread input.
pub(crate) fn drop_input() {
    let _ = tcflush(io::stdin(), QueueSelector::IFlush);
}

/// Reads from the terminal; waits for input.
///
/// # Errors
/// If the terminal is gone.
pub(crate) fn read(bytes: &mut [u8]) -> io::Result<usize> {
    loop {
        match rustix::io::read(io::stdin(), &mut *bytes) {
            Err(Errno::INTR) => {}
            read => return Ok(read?),
        }
    }
}

/// Reads the available input; waits for some, up to `limit`. Returns nothing after that.
///
/// # Errors
/// If the terminal is gone.
pub(crate) fn read_within(limit: Duration) -> io::Result<Vec<u8>> {
    let stdin = io::stdin();
    let limit = Timespec::try_from(limit).ok();
    match poll(&mut [PollFd::new(&stdin, PollFlags::IN)], limit.as_ref()) {
        Ok(0) | Err(Errno::INTR) => return Ok(Vec::new()),
        ready => ready?,
    };
    let mut bytes = [0; 256];
    match rustix::io::read(&stdin, &mut bytes) {
        Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
        Err(Errno::INTR | Errno::AGAIN) => Ok(Vec::new()),
        read => Ok(bytes.get(..read?).unwrap_or_default().to_vec()),
    }
}

/// Writes to the terminal at once.
///
/// # Errors
/// If the terminal is gone.
pub(crate) fn write(bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(bytes)?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read;
    use std::process::Command;

    use rustix::fs::OFlags;
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    use super::*;

    #[test]
    #[ignore = "the next test runs it in a terminal"]
    fn panics_with_the_terminal() {
        take(Mode::Screen).unwrap();
        std::thread::spawn(|| panic!("as it was asked to"))
            .join()
            .unwrap_err();
    }

    #[test]
    fn a_panic_on_any_thread_restores_the_terminal() {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).and_then(|()| unlockpt(&master)).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap();
        let open = || {
            rustix::fs::open(
                &path,
                OFlags::RDWR | OFlags::NOCTTY,
                rustix::fs::Mode::empty(),
            )
            .unwrap()
        };
        let terminal = open();
        let before = tcgetattr(&terminal).unwrap().local_modes;
        let mut child = Command::new("setsid");
        child.arg("--ctty").arg(std::env::current_exe().unwrap());
        child.args([
            "--exact",
            "--ignored",
            "--nocapture",
            "terminal_mode::tests::panics_with_the_terminal",
        ]);
        child
            .env("RUST_BACKTRACE", "0")
            .stdin(open())
            .stdout(open())
            .stderr(open());
        let mut running = child.spawn().unwrap();
        // Closes this process's copies of the child's end.
        drop(child);
        let mut output = File::from(master);
        let reader = std::thread::spawn(move || {
            let mut text = Vec::new();
            // Fails when the other end is closed.
            let _ = output.read_to_end(&mut text);
            String::from_utf8_lossy(&text).into_owned()
        });
        assert!(running.wait().unwrap().success());
        let after = tcgetattr(&terminal).unwrap().local_modes;
        drop(terminal);
        let text = reader.join().unwrap();
        let at = |part: &str| {
            text.find(part)
                .unwrap_or_else(|| panic!("no {part:?} in {text:?}"))
        };
        assert!(
            at(ENTER_SCREEN) < at(LEAVE_SCREEN) && at(LEAVE_SCREEN) < at("as it was asked to"),
            "{text:?}"
        );
        assert_eq!(before, after);
        assert!(after.contains(LocalModes::ICANON | LocalModes::ECHO));
    }
}
