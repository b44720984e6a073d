//! The manifest of a firmware image: for which board it is, its version and length, and the signature over all of it
//! (`docs/update.md`). A file for an update is a manifest and then the image.

use core::fmt;

/// Length of a manifest in bytes.
pub const MANIFEST_LEN: usize = HEAD_LEN + SIGNATURE_LEN;

/// Length of a manifest without its signature. These bytes are signed behind the image.
pub const HEAD_LEN: usize = BOARD + BOARD_LEN;

/// Length of the signature.
pub const SIGNATURE_LEN: usize = 64;

/// Most bytes of a board's name.
pub const BOARD_LEN: usize = 24;

/// An image's length is a multiple of this many bytes, the longest word of a flash.
pub const IMAGE_UNIT: usize = 32;

/// The first bytes.
const MAGIC: [u8; 4] = *b"ZTLF";

/// The format that follows.
const FORMAT: u8 = 1;

/// Where the board's name is.
const BOARD: usize = 16;

/// A version `X.Y.Z`; later ones are greater.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Version {
    /// X.
    pub major: u16,
    /// Y.
    pub minor: u16,
    /// Z.
    pub patch: u16,
}

impl Version {
    /// Reads three numbers from 0 to 65535, with points in between.
    ///
    /// # Errors
    /// [`BadVersion`] for anything else.
    pub const fn parse(text: &str) -> Result<Self, BadVersion> {
        let mut numbers = [0_u16; 3];
        let [major, minor, patch] = &mut numbers;
        let (first, rest) = number(text.as_bytes());
        let (second, rest) = number(after_point(rest));
        let (third, rest) = number(after_point(rest));
        match (first, second, third, rest) {
            (Some(first), Some(second), Some(third), []) => {
                (*major, *minor, *patch) = (first, second, third);
            }
            _ => return Err(BadVersion),
        }
        let [major, minor, patch] = numbers;
        Ok(Self {
            major,
            minor,
            patch,
        })
    }
}

/// The number at the beginning, and what follows it.
const fn number(text: &[u8]) -> (Option<u16>, &[u8]) {
    let mut rest = text;
    let mut number = None;
    while let [digit @ b'0'..=b'9', next @ ..] = rest {
        let before = match number {
            None => 0,
            Some(before) => before,
        };
        let Some(tenfold) = u16::checked_mul(before, 10) else {
            return (None, rest);
        };
        number = tenfold.checked_add((*digit - b'0') as u16);
        if number.is_none() {
            return (None, rest);
        }
        rest = next;
    }
    (number, rest)
}

/// What follows a point; nothing, which is no number, if there is none.
const fn after_point(text: &[u8]) -> &[u8] {
    match text {
        [b'.', rest @ ..] => rest,
        _ => &[],
    }
}

impl core::str::FromStr for Version {
    type Err = BadVersion;

    fn from_str(text: &str) -> Result<Self, BadVersion> {
        Self::parse(text)
    }
}

impl fmt::Display for Version {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            major,
            minor,
            patch,
        } = self;
        write!(f, "{major}.{minor}.{patch}")
    }
}

/// Not a version.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct BadVersion;

impl fmt::Display for BadVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("expected a version such as 1.2.3, with numbers up to 65535")
    }
}

impl core::error::Error for BadVersion {}

/// Why bytes are not a manifest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum ManifestError {
    /// There are fewer than [`MANIFEST_LEN`] bytes.
    Truncated,
    /// They do not begin like a manifest.
    NoManifest,
    /// A later program made it.
    Format {
        /// The number of its format.
        format: u8,
    },
    /// The board's name is empty, too long, or has other characters than letters, digits, `-`, `_` and `.`.
    Board,
    /// The image's length is 0 or not a multiple of [`IMAGE_UNIT`].
    Length {
        /// The length.
        length: u32,
    },
}

impl fmt::Display for ManifestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated => write!(f, "too short for a manifest of {MANIFEST_LEN} bytes"),
            Self::NoManifest => f.write_str("not a signed image: it does not begin with ZTLF"),
            Self::Format { format } => {
                write!(
                    f,
                    "the manifest has format {format}; this program knows format {FORMAT}"
                )
            }
            Self::Board => write!(
                f,
                "the board's name is not 1 to {BOARD_LEN} letters, digits, '-', '_' or '.'"
            ),
            Self::Length { length: 0 } => f.write_str("empty image"),
            Self::Length { length } => write!(
                f,
                "the image has {length} bytes; expected a multiple of {IMAGE_UNIT}"
            ),
        }
    }
}

impl core::error::Error for ManifestError {}

/// What a manifest says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Manifest<'a> {
    /// The board for which the image is: 1 to [`BOARD_LEN`] letters, digits, `-`, `_` and `.`.
    pub board: &'a str,
    /// Version of the image.
    pub version: Version,
    /// Length of the image in bytes, a multiple of [`IMAGE_UNIT`].
    pub length: u32,
}

impl<'a> Manifest<'a> {
    /// Reads the manifest at the beginning of these bytes. Does not verify the signature.
    ///
    /// # Errors
    /// [`ManifestError`] names what is wrong.
    pub fn parse(bytes: &'a [u8]) -> Result<Parsed<'a>, ManifestError> {
        let (head, rest) = bytes
            .split_first_chunk::<HEAD_LEN>()
            .ok_or(ManifestError::Truncated)?;
        let (signature, image) = rest.split_first_chunk().ok_or(ManifestError::Truncated)?;
        let (fields, board) = head
            .split_first_chunk::<BOARD>()
            .ok_or(ManifestError::Truncated)?;
        let [
            m0,
            m1,
            m2,
            m3,
            format,
            flags,
            a0,
            a1,
            b0,
            b1,
            c0,
            c1,
            rest @ ..,
        ] = *fields;
        if [m0, m1, m2, m3] != MAGIC {
            return Err(ManifestError::NoManifest);
        }
        // No flag is known yet; one that is set changes the meaning.
        if format != FORMAT || flags != 0 {
            return Err(ManifestError::Format { format });
        }
        let used = board.iter().position(|byte| *byte == 0);
        let (name, zeros) = board
            .split_at_checked(used.unwrap_or(BOARD_LEN))
            .unwrap_or_default();
        if zeros.iter().any(|byte| *byte != 0) {
            return Err(ManifestError::Board);
        }
        let name = core::str::from_utf8(name).map_err(|_| ManifestError::Board)?;
        let manifest = Self {
            board: name,
            version: Version {
                major: u16::from_le_bytes([a0, a1]),
                minor: u16::from_le_bytes([b0, b1]),
                patch: u16::from_le_bytes([c0, c1]),
            },
            length: u32::from_le_bytes(rest),
        };
        manifest.check()?;
        Ok(Parsed {
            manifest,
            head,
            signature,
            image,
        })
    }

    /// The bytes without the signature.
    ///
    /// # Errors
    /// [`ManifestError`] if the board's name or the length is not valid.
    pub fn head(&self) -> Result<[u8; HEAD_LEN], ManifestError> {
        self.check()?;
        let mut head = [0; HEAD_LEN];
        let version = self.version;
        let fields = MAGIC
            .into_iter()
            .chain([FORMAT, 0])
            .chain(version.major.to_le_bytes())
            .chain(version.minor.to_le_bytes())
            .chain(version.patch.to_le_bytes())
            .chain(self.length.to_le_bytes())
            .chain(self.board.bytes());
        for (to, from) in head.iter_mut().zip(fields) {
            *to = from;
        }
        Ok(head)
    }

    fn check(&self) -> Result<(), ManifestError> {
        let known = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
        if self.board.is_empty() || self.board.len() > BOARD_LEN || !self.board.bytes().all(known) {
            return Err(ManifestError::Board);
        }
        let length = self.length;
        if length == 0 || length & (IMAGE_UNIT as u32 - 1) != 0 {
            return Err(ManifestError::Length { length });
        }
        Ok(())
    }
}

/// A manifest in its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Parsed<'a> {
    /// What it says.
    pub manifest: Manifest<'a>,
    /// Its bytes without the signature.
    pub head: &'a [u8; HEAD_LEN],
    /// The ed25519 signature over the SHA-512 digest of the image, followed by `head`.
    pub signature: &'a [u8; SIGNATURE_LEN],
    /// The bytes that follow: in a file, the image.
    pub image: &'a [u8],
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::string::ToString;
    use std::vec::Vec;

    const MANIFEST: Manifest<'_> = Manifest {
        board: "desk-1",
        version: Version {
            major: 1,
            minor: 2,
            patch: 300,
        },
        length: 1024,
    };

    fn file() -> Vec<u8> {
        let mut bytes = MANIFEST.head().unwrap().to_vec();
        bytes.extend([0xA5; SIGNATURE_LEN]);
        bytes.extend(b"image");
        bytes
    }

    #[test]
    fn the_parts_are_where_the_document_says() {
        let file = file();
        let parsed = Manifest::parse(&file).unwrap();
        assert_eq!(parsed.manifest, MANIFEST);
        assert_eq!(parsed.head, &file[..40]);
        assert_eq!(parsed.signature, &[0xA5; 64]);
        assert_eq!(parsed.image, b"image");
        let head =
            b"ZTLF\x01\0\x01\0\x02\0\x2c\x01\0\x04\0\0desk-1\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0";
        assert_eq!(parsed.head, head);
    }

    #[test]
    fn versions_compare_by_their_numbers() {
        let parse = |text| Version::parse(text);
        assert!(parse("1.9.0").unwrap() < parse("1.10.0").unwrap());
        assert!(parse("0.65535.65535").unwrap() < parse("1.0.0").unwrap());
        assert_eq!(parse("10.0.3").unwrap().to_string(), "10.0.3");
        for wrong in [
            "",
            "1",
            "1.2",
            "1.2.",
            "1.2.3.",
            "1.2.3.4",
            "1.2.x",
            "-1.2.3",
            "1.2.65536",
            "1..3",
            " 1.2.3",
        ] {
            assert_eq!(parse(wrong), Err(BadVersion), "{wrong}");
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        let change = |at: usize, byte| {
            let mut file = file();
            file[at] = byte;
            Manifest::parse(&file).map(|_| ()).unwrap_err()
        };
        assert_eq!(change(0, b'z'), ManifestError::NoManifest);
        assert_eq!(change(4, 2), ManifestError::Format { format: 2 });
        assert_eq!(change(5, 1), ManifestError::Format { format: 1 });
        assert_eq!(change(12, 1), ManifestError::Length { length: 1025 });
        assert_eq!(change(13, 0), ManifestError::Length { length: 0 });
        assert_eq!(change(16, 0), ManifestError::Board);
        assert_eq!(change(17, b' '), ManifestError::Board);
        assert_eq!(change(39, 1), ManifestError::Board);
        let file = file();
        assert_eq!(Manifest::parse(&file[..103]), Err(ManifestError::Truncated));
        let board = "a-name-of-25-bytes-to-long";
        let long = Manifest { board, ..MANIFEST };
        assert_eq!(long.head(), Err(ManifestError::Board));
    }
}
