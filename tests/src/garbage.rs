//! Damaged files, made from a seed: a reader must not panic on any input.

/// A sequence of numbers that looks random and is the same in every run (xorshift).
pub struct Garbage(u64);

impl Garbage {
    /// Starts the sequence; `seed` must not be 0.
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// A number below `limit`; 0 if that is 0.
    pub fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        usize::try_from(self.0 >> 33).unwrap_or(0) % limit.max(1)
    }

    /// A file with some places written over.
    pub fn spoil(&mut self, whole: &str) -> Vec<u8> {
        let mut bytes = whole.as_bytes().to_vec();
        for _ in 0..=self.below(4) {
            let from = self.below(bytes.len());
            let to = (from + self.below(6)).min(bytes.len());
            let piece = self.bytes();
            let piece = piece.get(..self.below(6)).unwrap_or_default().to_vec();
            bytes.splice(from..to, piece);
        }
        bytes
    }

    /// Text of YAML's own pieces, with some bytes thrown in.
    pub fn bytes(&mut self) -> Vec<u8> {
        const PIECES: [&str; 36] = [
            "a",
            "port",
            ": ",
            ":",
            "\n",
            "\n  ",
            "\n\t",
            "- ",
            "[",
            "]",
            "{",
            "}",
            ", ",
            "&x ",
            "*x",
            "!",
            "!!str ",
            "!t!x ",
            "|\n",
            ">-\n",
            "\"",
            "'",
            "#",
            "? ",
            "%",
            "%TAG ! x\n",
            "---\n",
            "...\n",
            "\\",
            "\\x",
            "\u{feff}",
            "\u{85}",
            "ä",
            "\r\n",
            "<<",
            "\0",
        ];
        let mut bytes = Vec::new();
        for _ in 0..self.below(40) {
            match self.below(40) {
                0 => bytes.push(u8::try_from(self.below(256)).unwrap_or(0)),
                _ => bytes.extend_from_slice(PIECES[self.below(PIECES.len())].as_bytes()),
            }
        }
        bytes
    }
}
