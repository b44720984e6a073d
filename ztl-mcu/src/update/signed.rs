//! Verifies a signature of ed25519 in parts, between which a node handles its link.

use salty::{CompressedY, EdwardsPoint, Scalar, Sha512};
use ztl_core::manifest::SIGNATURE_LEN;

/// The check of one signature, which is `R` and `s`: it is valid if `R = s B - k A`, with the base point `B`, the public key `A`,
/// and `k`, the digest of `R`, `A` and the message.
///
/// Accepts what `salty::PublicKey::verify` accepts. That multiplies twice, in one call of 1024 additions of points. Here both
/// products are one sum, for a bit of `s` and `k` at a time. All of it is public, so the time may depend on it.
pub(super) struct Check {
    r: CompressedY,
    s: Scalar,
    k: Scalar,
    minus_key: EdwardsPoint,
    sum: EdwardsPoint,
    /// Bits that are left.
    bits: u16,
}

impl Check {
    /// `None` if the key is not a point of the curve. Takes about as long as 17 of the longest [steps](Self::step).
    // Not inlined, like `step`: its points would be part of the main loop's stack for ever. That saves 160 bytes in
    // `microbit-update`.
    #[inline(never)]
    pub(super) fn new(
        key: &[u8; 32],
        signature: &[u8; SIGNATURE_LEN],
        message: &[u8; 64],
    ) -> Option<Self> {
        let (r, s) = signature.split_first_chunk()?;
        let k = Sha512::new().updated(r).updated(key).updated(message);
        Some(Self {
            r: CompressedY(*r),
            s: Scalar(s.try_into().ok()?),
            k: Scalar::from_u512_le(&k.finalize()),
            minus_key: -&CompressedY(*key).decompressed().ok()?,
            sum: EdwardsPoint::neutral_element(),
            bits: 256,
        })
    }

    /// At most three additions of points, or what compares the sum in the end. Returns whether the signature is valid, once
    /// that is known.
    // Not inlined: that saves 104 bytes in `microbit-update`.
    #[inline(never)]
    pub(super) fn step(&mut self) -> Option<bool> {
        let Some(bit) = self.bits.checked_sub(1) else {
            return Some(self.sum.compressed() == self.r);
        };
        self.bits = bit;
        let is_set = |scalar: &Scalar| {
            let byte = scalar.0.get(usize::from(bit >> 3));
            byte.is_some_and(|byte| byte >> (bit & 7) & 1 == 1)
        };
        self.sum = &self.sum + &self.sum;
        if is_set(&self.s) {
            self.sum = &self.sum + &EdwardsPoint::basepoint();
        }
        if is_set(&self.k) {
            self.sum = &self.sum + &self.minus_key;
        }
        None
    }
}
