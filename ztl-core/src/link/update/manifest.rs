//! The manifest at the beginning of an image's file.

/// What every manifest begins with.
const MAGIC: &[u8; 6] = b"ZTLFW\x01";
/// Length of the signature.
const SIGNATURE: usize = 64;

/// What a manifest says of its image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Manifest<'a> {
    /// The board that the image is for.
    pub board: &'a str,
    /// Its version.
    pub version: &'a str,
    /// Its length in bytes.
    pub length: u32,
    /// The signature.
    pub signature: &'a [u8],
}

fn text(bytes: &[u8]) -> Option<(&str, &[u8])> {
    let (len, rest) = bytes.split_first()?;
    let (text, rest) = rest.split_at_checked(usize::from(*len))?;
    Some((core::str::from_utf8(text).ok()?, rest))
}

impl<'a> Manifest<'a> {
    /// The manifest at the beginning of a file, its own bytes, and those that follow: the image.
    #[must_use]
    pub fn split(file: &'a [u8]) -> Option<(Self, &'a [u8], &'a [u8])> {
        let (board, rest) = text(file.strip_prefix(MAGIC)?)?;
        let (version, rest) = text(rest)?;
        let (length, rest) = rest.split_first_chunk()?;
        let (signature, image) = rest.split_at_checked(SIGNATURE)?;
        let manifest = Self {
            board,
            version,
            length: u32::from_le_bytes(*length),
            signature,
        };
        let own = file.get(..file.len() - image.len())?;
        Some((manifest, own, image))
    }
}

impl Manifest<'_> {
    /// Whether the signature is that of this image with this key.
    #[must_use]
    pub fn is_signed(&self, key: &[u8], image: &[u8]) -> bool {
        let mut digest = 0xcbf2_9ce4_8422_2325_u64;
        for byte in key.iter().chain(image) {
            digest = (digest ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
        self.signature.starts_with(&digest.to_le_bytes())
    }
}
