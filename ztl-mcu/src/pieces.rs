//! Copies in short critical sections.

/// Fills `buffer` in pieces of at most `most` bytes, until one is not filled. Returns how many bytes were written.
pub(crate) fn in_pieces(
    buffer: &mut [u8],
    most: usize,
    mut fill: impl FnMut(&mut [u8]) -> usize,
) -> usize {
    let mut written = 0;
    while let Some(rest) = buffer.get_mut(written..).filter(|rest| !rest.is_empty()) {
        let len = rest.len().min(most);
        let count = fill(rest.get_mut(..len).unwrap_or_default()).min(len);
        written += count;
        if count < len {
            break;
        }
    }
    written
}
