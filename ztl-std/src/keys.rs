//! Keys for encrypted connections (CURVE), which identify clients and servers.
//!
//! A key pair is stored in two files in the format of CZMQ's and pyzmq's certificates: `NAME.key` with the
//! public key, to be shared, and `NAME.key_secret` with both keys, for its owner only.

use std::fmt;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use ztl_zmtp::curve;

use crate::{files, random};

/// Longest key file in bytes.
const MAX_FILE: u64 = 1 << 16;
/// Bytes of a key.
const LEN: usize = 32;
/// Characters of a key in Z85.
const TEXT_LEN: usize = 40;
/// The digits of Z85 (ZeroMQ RFC 32).
const DIGITS: &[u8; 85] =
    b"0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";

/// A public key, which identifies a client or a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PublicKey([u8; LEN]);

/// A key pair, with which a program identifies itself.
#[derive(Clone, PartialEq, Eq)]
pub struct KeyPair {
    public: PublicKey,
    secret: [u8; LEN],
}

/// The files of a client's keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyFiles {
    /// The client's secret key: `NAME.key_secret`.
    pub own: PathBuf,
    /// The server's public key: `NAME.key`.
    pub server: PathBuf,
}

/// A client's keys in a configuration: its own, and the server's.
#[cfg(feature = "config")]
pub(crate) const KEYS: [&str; 2] = ["key", "server-key"];

impl KeyFiles {
    /// Reads both.
    ///
    /// # Errors
    /// [`KeyError`] with the file.
    pub fn read(&self) -> Result<(KeyPair, PublicKey), KeyError> {
        Ok((KeyPair::read(&self.own)?, PublicKey::read(&self.server)?))
    }

    /// Takes `key` and `server-key` from a configuration, and checks the files. Paths are relative to `base`.
    #[cfg(feature = "config")]
    pub fn take<'d>(
        reading: &mut ztl_yaml::Reading<'d>,
        fields: &mut ztl_yaml::Fields<'d>,
        base: &Path,
    ) -> Option<Self> {
        let [own, server] = KEYS.map(|key| fields.present(key));
        let (own_at, server_at) = match (own, server) {
            (Some(own), Some(server)) => (own, server),
            (None, None) => return None,
            (Some(one), None) | (None, Some(one)) => {
                let both = "an encrypted connection needs both: key: robot.key_secret, server-key: far.key";
                reading.wrong(one, both);
                return None;
            }
        };
        let what = "a file of `ztl keys`";
        let own = reading.text(own_at, what);
        let server = reading.text(server_at, what);
        let files = Self {
            own: base.join(own?),
            server: base.join(server?),
        };
        Some(files)
    }
}

/// What is wrong with a key or its file.
#[derive(Debug)]
#[non_exhaustive]
pub enum KeyError {
    /// This libzmq cannot encrypt.
    NoCurve,
    /// A file cannot be read or written.
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        cause: io::Error,
    },
    /// A file has no key of this name.
    Missing {
        /// The file.
        path: PathBuf,
        /// `public-key` or `secret-key`.
        name: &'static str,
    },
    /// A text is not a key.
    Text,
    /// A line of a file is not a key.
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
    /// Everybody can pretend to have the secret key of this public one.
    Weak,
    /// The same, in a file.
    WeakFile {
        /// The file.
        path: PathBuf,
    },
    /// The file exists; a key is never overwritten.
    Exists {
        /// The file.
        path: PathBuf,
    },
}

impl fmt::Display for KeyError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoCurve => {
                f.write_str("this libzmq cannot encrypt; leave out `--transport libzmq`")
            }
            Self::File { path, cause } => write!(f, "{}: {cause}", path.display()),
            Self::Missing { path, name } => write!(
                f,
                "{}: there is no line `{name} = \"…\"`; make keys with `ztl keys NAME`",
                path.display()
            ),
            Self::Text => write!(f, "a key is {TEXT_LEN} characters of Z85"),
            Self::Line { path, line } => write!(
                f,
                "{}:{line}: a key is {TEXT_LEN} characters of Z85, in quotes",
                path.display()
            ),
            Self::Weak => f.write_str(
                "everybody can pretend to have this public key; make keys with `ztl keys NAME`",
            ),
            Self::WeakFile { path } => write!(f, "{}: {}", path.display(), Self::Weak),
            Self::Exists { path } => write!(
                f,
                "{} is there already, and a key is not overwritten; choose another name",
                path.display()
            ),
        }
    }
}

impl std::error::Error for KeyError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        match self {
            Self::File { cause, .. } => Some(cause),
            _ => None,
        }
    }
}

impl PublicKey {
    /// Reads the public key from either file of a pair.
    ///
    /// # Errors
    /// [`KeyError`] with the file, and the line where there is one.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        public(path, &read(path)?)
    }

    /// Reads the public keys in a directory (`*.key`) or in one file.
    ///
    /// # Errors
    /// [`KeyError`] for the first unreadable key; none is skipped.
    pub fn read_all(path: &Path) -> Result<Vec<Self>, KeyError> {
        if !path.is_dir() {
            return Self::read(path).map(|key| vec![key]);
        }
        let failed = |cause| KeyError::File {
            path: path.to_owned(),
            cause,
        };
        let mut keys = Vec::new();
        for entry in fs::read_dir(path).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            if path.extension().is_some_and(|extension| extension == "key") {
                keys.push(Self::read(&path)?);
            }
        }
        Ok(keys)
    }

    /// Its bytes.
    #[must_use]
    pub const fn as_bytes(&self) -> &[u8; LEN] {
        &self.0
    }

    pub(crate) const fn from_bytes(bytes: [u8; LEN]) -> Self {
        Self(bytes)
    }
}

/// Writes the key in Z85.
impl fmt::Display for PublicKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&z85(&self.0))
    }
}

impl FromStr for PublicKey {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        let key = from_z85(text).ok_or(KeyError::Text)?;
        match curve::is_weak(&key) {
            true => Err(KeyError::Weak),
            false => Ok(Self(key)),
        }
    }
}

/// Hides the secret key.
impl fmt::Debug for KeyPair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "KeyPair({})", self.public)
    }
}

impl KeyPair {
    /// Generates a pair.
    ///
    /// # Panics
    /// If the system has no random source.
    #[must_use]
    pub fn generate() -> Self {
        let secret = random::secret();
        Self {
            public: PublicKey(curve::public_key(&secret)),
            secret,
        }
    }

    /// Reads a pair from `NAME.key_secret`.
    ///
    /// # Errors
    /// [`KeyError`] with the file, and the line where there is one.
    pub fn read(path: &Path) -> Result<Self, KeyError> {
        let text = read(path)?;
        Ok(Self {
            public: public(path, &text)?,
            secret: field(path, &text, "secret-key")?,
        })
    }

    /// Writes the pair to `NAME.key` and `NAME.key_secret`, the latter readable only by its owner; returns their
    /// paths.
    ///
    /// # Errors
    /// [`KeyError`] with the file; nothing is overwritten.
    pub fn write(&self, name: &Path) -> Result<[PathBuf; 2], KeyError> {
        let [public, secret] = ["key", "key_secret"].map(|end| {
            let mut path = name.as_os_str().to_owned();
            path.push(".");
            path.push(end);
            PathBuf::from(path)
        });
        let line = |name: &str, key| format!("    {name} = \"{}\"\n", z85(key));
        let open = format!("curve\n{}", line("public-key", &self.public.0));
        let shared = format!("# The public key, to be shared.\n{open}");
        let kept = format!(
            "# The secret key, only for its owner.\n{open}{}",
            line("secret-key", &self.secret)
        );
        create(&secret, &kept, 0o600)?;
        if let Err(error) = create(&public, &shared, 0o644) {
            // Does not leave half a pair.
            let _ = fs::remove_file(&secret);
            return Err(error);
        }
        Ok([public, secret])
    }

    /// The public key.
    #[must_use]
    pub const fn public(&self) -> PublicKey {
        self.public
    }

    /// The secret key's bytes.
    #[must_use]
    pub const fn secret(&self) -> &[u8; LEN] {
        &self.secret
    }
}

/// A warning if others than its owner can read the file of a secret key.
#[cfg(unix)]
#[must_use]
pub fn exposure(path: &Path) -> Option<String> {
    use std::os::unix::fs::PermissionsExt;

    let mode = fs::metadata(path).ok()?.permissions().mode() & 0o777;
    let path = path.display();
    (mode & 0o077 != 0).then(|| {
        format!("{path}: others can use this secret key (mode {mode:03o}); run: chmod 600 {path}")
    })
}

/// Unknown on this system.
#[cfg(not(unix))]
#[must_use]
pub fn exposure(_path: &Path) -> Option<String> {
    None
}

fn read(path: &Path) -> Result<String, KeyError> {
    let text = files::read(path, MAX_FILE)
        .and_then(|bytes| String::from_utf8(bytes).map_err(|_| io::ErrorKind::InvalidData.into()));
    text.map_err(|cause| KeyError::File {
        path: path.to_owned(),
        cause,
    })
}

/// Creates a file with this content and mode.
fn create(path: &Path, content: &str, mode: u32) -> Result<(), KeyError> {
    let mut options = fs::OpenOptions::new();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, mode);
    #[cfg(not(unix))]
    let _ = mode;
    let written = options
        .open(path)
        .and_then(|mut file| file.write_all(content.as_bytes()));
    written.map_err(|cause| match cause.kind() {
        io::ErrorKind::AlreadyExists => KeyError::Exists {
            path: path.to_owned(),
        },
        _ => KeyError::File {
            path: path.to_owned(),
            cause,
        },
    })
}

/// The public key of a file. CZMQ writes one of zeros where it cannot encrypt.
fn public(path: &Path, text: &str) -> Result<PublicKey, KeyError> {
    let key = field(path, text, "public-key")?;
    match curve::is_weak(&key) {
        true => Err(KeyError::WeakFile {
            path: path.to_owned(),
        }),
        false => Ok(PublicKey(key)),
    }
}

/// The key on the line `NAME = "KEY"`.
fn field(path: &Path, text: &str, name: &'static str) -> Result<[u8; LEN], KeyError> {
    for (number, line) in text.lines().enumerate() {
        let Some((found, value)) = line.split_once('=') else {
            continue;
        };
        if found.trim() != name {
            continue;
        }
        let key = value
            .trim()
            .strip_prefix('"')
            .and_then(|value| value.strip_suffix('"'))
            .and_then(from_z85);
        return key.ok_or(KeyError::Line {
            path: path.to_owned(),
            line: number + 1,
        });
    }
    Err(KeyError::Missing {
        path: path.to_owned(),
        name,
    })
}

fn z85(key: &[u8; LEN]) -> String {
    let mut text = String::with_capacity(TEXT_LEN);
    for four in key.chunks(4) {
        let value = four
            .iter()
            .fold(0u32, |value, byte| value << 8 | u32::from(*byte));
        for power in [85 * 85 * 85 * 85, 85 * 85 * 85, 85 * 85, 85, 1] {
            let digit = (value / power % 85) as usize;
            text.extend(DIGITS.get(digit).map(|digit| char::from(*digit)));
        }
    }
    text
}

/// Reads Z85 strictly; libzmq accepts any character as a digit.
fn from_z85(text: &str) -> Option<[u8; LEN]> {
    if text.len() != TEXT_LEN {
        return None;
    }
    let mut key = [0; LEN];
    for (to, five) in key.chunks_mut(4).zip(text.as_bytes().chunks(5)) {
        let mut value = 0u64;
        for byte in five {
            let digit = DIGITS.iter().position(|digit| digit == byte)?;
            value = value * 85 + digit as u64;
        }
        let value = u32::try_from(value).ok()?;
        to.copy_from_slice(&value.to_be_bytes());
    }
    Some(key)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From ZeroMQ's documentation of `zmq_curve`.
    const KNOWN: &str = "Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID";

    #[test]
    #[cfg(feature = "libzmq")]
    fn a_key_is_read_like_libzmq() {
        let key: PublicKey = KNOWN.parse().expect("a key");
        assert_eq!(zmq::z85_decode(KNOWN).expect("a key"), key.as_bytes());
        assert_eq!(key.to_string(), KNOWN);
    }

    #[test]
    fn an_invalid_key_is_rejected() {
        for text in [
            "",
            "short",
            &KNOWN[1..],
            &format!("{KNOWN}0"),
            // Not a digit of Z85, and a group above 32 bits.
            &KNOWN.replace('Y', "~"),
            &format!("#####{}", &KNOWN[5..]),
            &"ä".repeat(20),
        ] {
            assert!(text.parse::<PublicKey>().is_err(), "{text}");
        }
        let weak = "0".repeat(TEXT_LEN).parse::<PublicKey>();
        assert!(matches!(weak, Err(KeyError::Weak)), "{weak:?}");
    }

    #[test]
    fn a_pair_survives_its_files_and_nothing_is_overwritten() {
        let directory = std::env::temp_dir().join(format!("ztl-keys-{}", random::number()));
        fs::create_dir(&directory).expect("a directory");
        let pair = KeyPair {
            public: KNOWN.parse().expect("a key"),
            secret: [7; LEN],
        };
        let name = directory.join("robot");
        let [public, secret] = pair.write(&name).expect("to write");
        assert_eq!(KeyPair::read(&secret).expect("a pair"), pair);
        assert_eq!(PublicKey::read(&public).expect("a key"), pair.public());
        assert_eq!(
            PublicKey::read_all(&directory).expect("keys"),
            [pair.public()]
        );
        assert!(matches!(
            KeyPair::read(&public),
            Err(KeyError::Missing { .. })
        ));
        assert!(matches!(pair.write(&name), Err(KeyError::Exists { .. })));
        let zeros = "0".repeat(TEXT_LEN);
        let zeros = format!("curve\n    public-key = \"{zeros}\"\n    secret-key = \"{zeros}\"\n");
        fs::write(&public, zeros).expect("to write");
        let error = PublicKey::read_all(&directory).expect_err("no key");
        assert!(matches!(error, KeyError::WeakFile { .. }), "{error}");
        assert!(KeyPair::read(&public).is_err());
        fs::write(&public, "curve\n    public-key = \"wrong\"\n").expect("to write");
        let error = PublicKey::read_all(&directory).expect_err("no key");
        assert!(matches!(error, KeyError::Line { line: 2, .. }), "{error}");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = fs::metadata(&secret)
                .expect("the file")
                .permissions()
                .mode();
            assert_eq!(mode & 0o777, 0o600);
        }
        fs::remove_dir_all(&directory).expect("to clean up");
    }

    #[test]
    fn each_key_pair_is_another_one() {
        let [one, other] = [KeyPair::generate(), KeyPair::generate()];
        assert!(one.public != other.public && one.public.0 != one.secret);
    }
}
