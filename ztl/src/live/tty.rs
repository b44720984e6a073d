//! The terminal: taken for a screen, and given back whatever happens.

use std::io::{self, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, Once, PoisonError};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{OptionalActions, Termios, tcgetattr, tcsetattr};
use signal_hook::consts::{SIGCONT, SIGQUIT, SIGTSTP};
use signal_hook::low_level::emulate_default_handler;

/// How the terminal was before it was taken. `None`: it is not taken.
static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);
/// Somebody wants the terminal to be as it was, for good.
static CLOSED: AtomicBool = AtomicBool::new(false);
/// Counts how often the screen was taken: what was drawn before is gone.
static TAKEN: AtomicU32 = AtomicU32::new(0);

/// Another screen than that of the shell, without a cursor.
const ENTER: &str = "\x1b[?1049h\x1b[?25l\x1b[2J";
const LEAVE: &str = "\x1b[0m\x1b[2J\x1b[?25h\x1b[?1049l";

fn before() -> MutexGuard<'static, Option<Termios>> {
    BEFORE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Whether there is a terminal to show on and to read keys from.
pub(crate) fn is_there() -> bool {
    let dumb = std::env::var("TERM").is_ok_and(|term| term == "dumb" || term.is_empty());
    io::stdin().is_terminal() && io::stdout().is_terminal() && !dumb
}

/// Takes the terminal until [`restore`]; a panic, being stopped (Ctrl-Z) and SIGQUIT give it back by
/// themselves.
pub(super) fn take() -> io::Result<()> {
    CLOSED.store(false, Ordering::SeqCst);
    enter()?;
    static HOOKS: Once = Once::new();
    let mut hooked = Ok(());
    HOOKS.call_once(|| {
        let tell = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            restore();
            tell(panic);
        }));
        hooked = watch_signals();
    });
    if hooked.is_err() {
        restore();
    }
    hooked
}

/// Gives the terminal back, for good. To be called from anywhere, as often as one likes.
pub(crate) fn restore() {
    CLOSED.store(true, Ordering::SeqCst);
    leave();
}

/// Whether it was given back.
pub(super) fn is_closed() -> bool {
    CLOSED.load(Ordering::SeqCst)
}

/// Changes whenever all has to be drawn again.
pub(super) fn taken() -> u32 {
    TAKEN.load(Ordering::SeqCst)
}

fn enter() -> io::Result<()> {
    let mut before = before();
    if before.is_none() {
        let was = tcgetattr(io::stdin())?;
        let mut raw = was.clone();
        raw.make_raw();
        // What is typed ahead is thrown away.
        tcsetattr(io::stdin(), OptionalActions::Flush, &raw)?;
        *before = Some(was);
    }
    write(ENTER.as_bytes())?;
    TAKEN.fetch_add(1, Ordering::SeqCst);
    Ok(())
}

fn leave() {
    let mut before = before();
    if let Some(was) = before.take() {
        // A terminal that has gone needs neither.
        let _ = write(LEAVE.as_bytes());
        let _ = tcsetattr(io::stdin(), OptionalActions::Flush, &was);
    }
}

/// Gives the terminal back, stops this process as the shell expects it, and takes the terminal again
/// when it is let on.
pub(super) fn suspend() {
    leave();
    let _ = emulate_default_handler(SIGTSTP);
    resume();
}

/// Takes the terminal again, if this process may use it.
fn resume() {
    if is_closed() || !in_foreground() {
        return;
    }
    // The shell has left it as it likes it.
    let _ = enter();
}

fn in_foreground() -> bool {
    let group = rustix::termios::tcgetpgrp(io::stdin());
    group.is_ok_and(|group| group == rustix::process::getpgrp())
}

fn watch_signals() -> io::Result<()> {
    let mut signals = signal_hook::iterator::Signals::new([SIGTSTP, SIGCONT, SIGQUIT])?;
    std::thread::Builder::new()
        .name("ztl-terminal".to_owned())
        .spawn(move || {
            for signal in signals.forever() {
                match signal {
                    SIGTSTP if !is_closed() => suspend(),
                    SIGCONT => again(),
                    SIGQUIT => {
                        restore();
                        let _ = emulate_default_handler(SIGQUIT);
                    }
                    other => drop(emulate_default_handler(other)),
                }
            }
        })?;
    Ok(())
}

/// It was stopped by somebody else and is let on: the shell may have altered the terminal.
fn again() {
    if !is_closed() && in_foreground() {
        if let Some(was) = before().take() {
            let _ = tcsetattr(io::stdin(), OptionalActions::Now, &was);
        }
        resume();
    }
}

/// Columns and lines.
pub(super) fn size() -> (usize, usize) {
    let size = terminal_size::terminal_size();
    let (width, height) = size.map_or((80, 24), |(width, height)| (width.0, height.0));
    // A terminal that does not know its size says 0.
    let or = |is: u16, usual: usize| if is == 0 { usual } else { usize::from(is) };
    (or(width, 80), or(height, 24))
}

/// What was typed, as soon as anything is, at most after `limit`; empty if nothing. An error means
/// that the terminal has gone.
pub(super) fn read(limit: Duration) -> io::Result<Vec<u8>> {
    let stdin = io::stdin();
    let limit = Timespec::try_from(limit).ok();
    let mut ready = [PollFd::new(&stdin, PollFlags::IN)];
    match poll(&mut ready, limit.as_ref()) {
        Ok(0) | Err(rustix::io::Errno::INTR) => return Ok(Vec::new()),
        Ok(_) => {}
        Err(error) => return Err(error.into()),
    }
    let mut bytes = [0; 256];
    match rustix::io::read(&stdin, &mut bytes) {
        Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
        Ok(count) => Ok(bytes.get(..count).unwrap_or_default().to_vec()),
        Err(rustix::io::Errno::INTR | rustix::io::Errno::AGAIN) => Ok(Vec::new()),
        Err(error) => Err(error.into()),
    }
}

pub(super) fn write(bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(bytes)?;
    out.flush()
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read;
    use std::process::Command;

    use rustix::fs::{Mode, OFlags};
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    use rustix::termios::LocalModes;

    use super::*;

    #[test]
    #[ignore = "is run in a terminal of its own by the next"]
    fn panics_with_the_terminal() {
        take().unwrap();
        std::thread::spawn(|| panic!("as it was asked to"))
            .join()
            .unwrap_err();
    }

    #[test]
    fn a_panic_on_any_thread_gives_the_terminal_back() {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).and_then(|()| unlockpt(&master)).unwrap();
        let path = ptsname(&master, Vec::new()).unwrap();
        let open =
            || rustix::fs::open(&path, OFlags::RDWR | OFlags::NOCTTY, Mode::empty()).unwrap();
        let terminal = open();
        let before = tcgetattr(&terminal).unwrap().local_modes;
        let mut child = Command::new("setsid");
        child.arg("--ctty").arg(std::env::current_exe().unwrap());
        child.args([
            "--exact",
            "--ignored",
            "--nocapture",
            "live::tty::tests::panics_with_the_terminal",
        ]);
        child
            .env("RUST_BACKTRACE", "0")
            .stdin(open())
            .stdout(open())
            .stderr(open());
        let mut running = child.spawn().unwrap();
        // The ends that the child has are its own now.
        drop(child);
        let mut output = File::from(master);
        let reader = std::thread::spawn(move || {
            let mut text = Vec::new();
            // Ends by an error when nobody has the other end.
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
            at(ENTER) < at(LEAVE) && at(LEAVE) < at("as it was asked to"),
            "{text:?}"
        );
        assert_eq!(before, after);
        assert!(after.contains(LocalModes::ICANON | LocalModes::ECHO));
    }
}
