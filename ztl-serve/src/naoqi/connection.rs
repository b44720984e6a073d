//! The client of NAOqi that all components of a file share. It starts with the first that needs it.

use std::fs;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use tracing::{info, warn};
use ztl_naoqi::{Client, Credentials, Endpoint, Event, Limits, Options};

use crate::log::LOG;
use crate::secret;

/// The longest token, in bytes.
const LONGEST_TOKEN: u64 = 4096;

/// The robot, connected once that is needed.
#[derive(Debug)]
pub(crate) struct Robot {
    /// An address that was checked.
    directory: String,
    /// The user, and the file with the token.
    user: Option<(String, PathBuf)>,
    client: Mutex<Option<Client>>,
}

impl Robot {
    pub(super) fn new(directory: String, user: Option<(String, PathBuf)>) -> Arc<Self> {
        Arc::new(Self {
            directory,
            user,
            client: Mutex::new(None),
        })
    }

    /// The client. It works also while the robot does not answer.
    ///
    /// # Errors
    /// Why it cannot start.
    pub(crate) fn client(&self) -> Result<Client, String> {
        let mut client = self.client.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(client) = &*client {
            return Ok(client.clone());
        }
        let credentials = self.user.as_ref().map(|(user, file)| {
            Ok::<_, String>(Credentials {
                user: user.clone(),
                token: token(file)?,
            })
        });
        let options = Options {
            directory: Endpoint::parse(&self.directory)?,
            credentials: credentials.transpose()?,
            limits: Limits::default(),
        };
        let (directory, file) = (self.directory.clone(), self.user.clone());
        let on_event = move |event| match event {
            Event::Connected => info!(target: LOG, "Connected to NAOqi at {directory}."),
            Event::Disconnected { reason } => {
                warn!(target: LOG, "No connection to NAOqi, which is tried again: {reason}");
            }
            Event::NewToken(token) => {
                if let Some((_, file)) = &file
                    && let Err(error) = keep(file, &token)
                {
                    let file = file.display();
                    warn!(target: LOG, "The robot has chosen a new token, and {file} cannot be written: {error}. Without it, the next start is refused.");
                }
            }
            _ => {}
        };
        let started = Client::start(options, on_event).map_err(|error| error.to_string())?;
        Ok(client.insert(started).clone())
    }
}

/// Reads a token.
pub(super) fn token(file: &Path) -> Result<String, String> {
    let text = secret::read(file, LONGEST_TOKEN)?;
    match text.trim() {
        "" => Err(format!(
            "{} is empty; write the robot's password into it",
            file.display()
        )),
        token => Ok(token.to_owned()),
    }
}

/// Replaces a token, so that the file has the old or the new one at any time.
fn keep(file: &Path, token: &str) -> std::io::Result<()> {
    let mut new = file.as_os_str().to_owned();
    new.push(".new");
    let mut options = fs::OpenOptions::new();
    options.write(true).create(true).truncate(true).mode(0o600);
    let mut written = options.open(&new)?;
    written.write_all(format!("{token}\n").as_bytes())?;
    written.sync_all()?;
    fs::rename(&new, file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_token_replaces_the_old_one_and_only_its_owner_may_read_it() {
        use std::os::unix::fs::PermissionsExt as _;
        let scratch = ztl_tests::lab::Scratch::new();
        let file = scratch.path("token.txt");
        assert!(token(&file).is_err_and(|it| it.contains("token.txt: No such file")));
        keep(&file, "first").expect("to write");
        keep(&file, "second").expect("to write");
        assert_eq!(token(&file).as_deref(), Ok("second"));
        let mode = fs::metadata(&file).expect("a file").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        fs::write(&file, " \n").expect("to write");
        assert!(token(&file).is_err_and(|it| it.contains("is empty")));
        fs::write(&file, "x".repeat(4097)).expect("to write");
        assert!(token(&file).is_err_and(|it| it.ends_with("it has more than 4096 bytes")));
        // Its length is said to be zero, and it never ends.
        let endless = token(Path::new("/dev/zero"));
        assert!(endless.is_err_and(|it| it == "/dev/zero: it is not a regular file"));
    }
}
