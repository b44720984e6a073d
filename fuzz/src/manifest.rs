//! Checks manifests of firmware images.

use ztl_core::manifest::{Manifest, Parsed, Version};

/// Bytes are a manifest that is written back unchanged, or an error; a text is a version that is written back with the same
/// numbers, or an error.
///
/// # Panics
/// If that is not so.
pub fn check(bytes: &[u8]) {
    match Manifest::parse(bytes) {
        Ok(Parsed {
            manifest,
            head,
            signature,
            image,
        }) => {
            assert_eq!(manifest.head().as_ref(), Ok(head));
            assert_eq!([head.as_slice(), signature, image].concat(), bytes);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
    if let Ok(text) = core::str::from_utf8(bytes)
        && let Ok(version) = Version::parse(text)
    {
        assert_eq!(Version::parse(&version.to_string()), Ok(version));
    }
}
