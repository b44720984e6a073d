//! Single keys from a terminal, never buffered ahead, and the terminal as it was afterwards, whatever
//! happens.

use std::io;
use std::sync::mpsc::{self, Receiver};
use std::time::Instant;

/// What a terminal sent at once: one key, however many bytes it has.
#[derive(Debug, Clone)]
pub(crate) struct Key {
    /// The bytes, at least one.
    pub(crate) bytes: Vec<u8>,
    /// When they came.
    pub(crate) at: Instant,
}

/// The keys of the terminal that is this process's stdin. From [`open`](Self::open) on nothing that is
/// typed is shown or waits for Enter; dropped, it leaves the terminal as it was.
#[derive(Debug)]
pub(crate) struct Keyboard {
    keys: Receiver<Key>,
    _mode: mode::Guard,
}

impl Keyboard {
    /// Takes the keyboard; `wake` is called after each key, on a thread of its own.
    ///
    /// # Errors
    /// When stdin is no terminal.
    pub(crate) fn open(wake: impl Fn() + Send + 'static) -> io::Result<Self> {
        let mode = mode::Guard::take()?;
        let (sender, keys) = mpsc::channel();
        std::thread::Builder::new()
            .name("ztl-keys".to_owned())
            .spawn(move || {
                let mut bytes = [0; 64];
                while let Ok(len @ 1..) = mode::read(&mut bytes) {
                    let bytes = bytes.get(..len).unwrap_or_default().to_vec();
                    let key = Key {
                        bytes,
                        at: Instant::now(),
                    };
                    if sender.send(key).is_err() {
                        return;
                    }
                    wake();
                }
            })?;
        Ok(Self { keys, _mode: mode })
    }

    /// Leaves the terminal as it was before anybody took its keys.
    pub(crate) fn restore() {
        mode::restore();
    }

    /// The next key, if one was pressed.
    pub(crate) fn next(&self) -> Option<Key> {
        self.keys.try_recv().ok()
    }

    /// Forgets what was pressed until now: it was not meant for what is asked next.
    pub(crate) fn forget(&self) {
        mode::flush();
        while self.keys.try_recv().is_ok() {}
    }
}

#[cfg(unix)]
mod mode {
    use std::io;
    use std::sync::{Mutex, Once, PoisonError};

    use rustix::termios::{
        InputModes, LocalModes, OptionalActions, QueueSelector, SpecialCodeIndex, Termios, isatty,
        tcflush, tcgetattr, tcsetattr,
    };
    use signal_hook::consts::SIGQUIT;
    use signal_hook::low_level::emulate_default_handler;

    /// How the terminal was, while it is not so.
    static BEFORE: Mutex<Option<Termios>> = Mutex::new(None);

    #[derive(Debug)]
    pub(super) struct Guard;

    impl Guard {
        pub(super) fn take() -> io::Result<Self> {
            let stdin = &io::stdin();
            if !isatty(stdin) {
                return Err(io::Error::from_raw_os_error(
                    rustix::io::Errno::NOTTY.raw_os_error(),
                ));
            }
            let before = tcgetattr(stdin)?;
            let mut keys = before.clone();
            keys.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
            // Enter is told from Ctrl-J. What is left on is Ctrl-C as a signal: it is obeyed whatever
            // this process is doing.
            keys.input_modes -= InputModes::ICRNL | InputModes::INLCR;
            for index in [SpecialCodeIndex::VSUSP, SpecialCodeIndex::VQUIT] {
                // Neither stops this process nor ends it with the terminal as it is.
                if let Some(code) = disabled() {
                    keys.special_codes[index] = code;
                }
            }
            keys.special_codes[SpecialCodeIndex::VMIN] = 1;
            keys.special_codes[SpecialCodeIndex::VTIME] = 0;
            lock().replace(before);
            restore_at_panic();
            restore_at_quit()?;
            tcsetattr(stdin, OptionalActions::Flush, &keys)?;
            Ok(Self)
        }
    }

    impl Drop for Guard {
        fn drop(&mut self) {
            restore();
        }
    }

    /// The code that stands for no key.
    #[expect(clippy::unnecessary_wraps, reason = "not every system has one")]
    const fn disabled() -> Option<u8> {
        Some(if cfg!(any(target_os = "linux", target_os = "android")) {
            0
        } else {
            0xff
        })
    }

    fn lock() -> std::sync::MutexGuard<'static, Option<Termios>> {
        BEFORE.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn restore() {
        if let Some(before) = lock().take() {
            // That would wait for the output, which may stand still, if it flushed by itself.
            flush();
            let _ = tcsetattr(io::stdin(), OptionalActions::Now, &before);
        }
    }

    /// A panic on any thread is told on a terminal that shows lines as they are.
    fn restore_at_panic() {
        static ONCE: Once = Once::new();
        ONCE.call_once(|| {
            let told = std::panic::take_hook();
            std::panic::set_hook(Box::new(move |panic| {
                restore();
                told(panic);
            }));
        });
    }

    /// SIGQUIT ends this process as ever, with the terminal as it was.
    fn restore_at_quit() -> io::Result<()> {
        static ONCE: Once = Once::new();
        let mut watched = Ok(());
        ONCE.call_once(|| watched = watch_quit());
        watched
    }

    fn watch_quit() -> io::Result<()> {
        let mut signals = signal_hook::iterator::Signals::new([SIGQUIT])?;
        std::thread::Builder::new()
            .name("ztl-terminal".to_owned())
            .spawn(move || {
                for signal in signals.forever() {
                    restore();
                    let _ = emulate_default_handler(signal);
                }
            })?;
        Ok(())
    }

    pub(super) fn flush() {
        let _ = tcflush(io::stdin(), QueueSelector::IFlush);
    }

    pub(super) fn read(bytes: &mut [u8]) -> io::Result<usize> {
        loop {
            match rustix::io::read(io::stdin(), &mut *bytes) {
                Err(rustix::io::Errno::INTR) => {}
                Ok(len) => return Ok(len),
                Err(error) => return Err(error.into()),
            }
        }
    }
}

#[cfg(not(unix))]
mod mode {
    use std::io;

    #[derive(Debug)]
    pub(super) struct Guard;

    impl Guard {
        pub(super) fn take() -> io::Result<Self> {
            Err(io::Error::new(
                io::ErrorKind::Unsupported,
                "no keys here; use --yes",
            ))
        }
    }

    pub(super) fn restore() {}

    pub(super) fn flush() {}

    pub(super) fn read(_bytes: &mut [u8]) -> io::Result<usize> {
        Ok(0)
    }
}
