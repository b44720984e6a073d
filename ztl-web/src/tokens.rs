//! The secrets of a console.

use std::fs;
use std::io::{self, Write as _};
use std::path::Path;

use ztl_std::files;

/// The length of a token: 128 bits in hexadecimal.
const LENGTH: usize = 32;
/// The longest file with secrets, in bytes; one has 83.
const LONGEST: u64 = 1024;

/// The secrets of a console.
#[derive(Clone, PartialEq, Eq)]
pub struct Tokens {
    /// Whoever has it may start tasks.
    pub operator: String,
    /// Whoever has it may look and stop.
    pub watcher: String,
}

impl Tokens {
    /// New random tokens.
    ///
    /// # Errors
    /// If the system gives no random numbers.
    pub fn random() -> io::Result<Self> {
        let token = || {
            let mut bytes = [0; LENGTH / 2];
            getrandom::fill(&mut bytes).map_err(io::Error::other)?;
            Ok::<_, io::Error>(format!("{:032x}", u128::from_be_bytes(bytes)))
        };
        Ok(Self {
            operator: token()?,
            watcher: token()?,
        })
    }

    /// The tokens in a file. If it is missing, it is made with new ones, for its owner only.
    ///
    /// # Errors
    /// If it cannot be read or made, or contains something else.
    pub fn kept(path: &Path) -> io::Result<Self> {
        match files::read_text(path, LONGEST) {
            Ok(text) => Self::parse(&text).ok_or_else(|| {
                let why = "expected the lines `operator TOKEN` and `watcher TOKEN`, of 32 hexadecimal digits each";
                io::Error::new(io::ErrorKind::InvalidData, why)
            }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let tokens = Self::random()?;
                let mut options = fs::OpenOptions::new();
                options.write(true).create_new(true);
                #[cfg(unix)]
                std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
                let Self { operator, watcher } = &tokens;
                let text = format!("operator {operator}\nwatcher {watcher}\n");
                options.open(path)?.write_all(text.as_bytes())?;
                Ok(tokens)
            }
            Err(error) => Err(error),
        }
    }

    fn parse(text: &str) -> Option<Self> {
        let is_token = |token: &&str| {
            token.len() == LENGTH && token.bytes().all(|byte| byte.is_ascii_hexdigit())
        };
        let mut lines = text.lines();
        let mut next = |name: &str| {
            let token = lines.next()?.strip_prefix(name)?.strip_prefix(' ')?;
            Some(token).filter(is_token).map(str::to_owned)
        };
        let (operator, watcher) = (next("operator")?, next("watcher")?);
        (operator != watcher && lines.next().is_none()).then_some(Self { operator, watcher })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_are_random_and_only_whole_files_are_read() {
        let [first, second] = [(); 2].map(|()| Tokens::random().expect("random"));
        assert_ne!(first.operator, first.watcher);
        assert_ne!(first.operator, second.operator);
        let Tokens { operator, watcher } = &first;
        assert_eq!(operator.len(), LENGTH);
        let whole = format!("operator {operator}\nwatcher {watcher}\n");
        assert!(Tokens::parse(&whole) == Some(first.clone()));
        for wrong in [
            String::new(),
            format!("operator {operator}\n"),
            format!("operator {operator}\nwatcher {operator}\n"),
            format!("operator \nwatcher {watcher}\n"),
            format!("{whole}x\n"),
            whole.replace("watcher", "other"),
        ] {
            assert!(Tokens::parse(&wrong).is_none(), "{wrong}");
        }
        let endless = Tokens::kept(Path::new("/dev/zero")).err();
        assert!(endless.is_some_and(|it| it.to_string() == "it is not a regular file"));
    }
}
