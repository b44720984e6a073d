//! Notes for the operator.

use super::RunBoard;

/// Most notes that are kept.
const MOST_NOTES: usize = 1000;

/// A note for the operator.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Note {
    /// Its number in the run, from 0.
    pub number: u64,
    /// What it says.
    pub text: String,
    /// Whether the operator has seen it.
    pub is_seen: bool,
}

impl RunBoard {
    pub(super) fn note(&mut self, text: String) {
        let last = self.notes.back();
        let note = Note {
            number: last.map_or(0, |last| last.number + 1),
            text,
            is_seen: false,
        };
        if self.notes.len() >= MOST_NOTES {
            self.notes.pop_front();
        }
        self.notes.push_back(note);
    }

    /// Takes it that the operator has seen the notes with these numbers.
    pub fn see_notes(&mut self, numbers: &[u64]) {
        for note in &mut self.notes {
            note.is_seen |= numbers.contains(&note.number);
        }
    }

    /// The notes that the operator has not seen, the newest ones last.
    pub fn unseen_notes(&self) -> impl DoubleEndedIterator<Item = &Note> {
        self.notes.iter().filter(|note| !note.is_seen)
    }
}
