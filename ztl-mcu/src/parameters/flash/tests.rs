//! A flash whose power is cut at every write and erase.

use super::*;
use crate::component::{Component, Refused, Report, Run};
use crate::parameters;
use crate::parameters::{Declaration, Kept, Text, Tunable, Tuned, Tuning, Value};
use embedded_storage::nor_flash::{NorFlashError, NorFlashErrorKind};
use std::format;
use std::string::String;
use std::vec::Vec;
use ztl_core::Instant;
use ztl_core::link::Offer;

const PAGE: usize = 512;
const PAGES: usize = 3;
const WORD: usize = 4;

/// A NOR flash: writing clears bits, erasing sets those of a page.
#[derive(Clone)]
struct Chip {
    bytes: Vec<u8>,
    /// Operations until the power is cut. Each word written and each page erased is one.
    left: usize,
    erases: usize,
    /// Whether something else has written to it.
    noisy: bool,
}

#[derive(Debug)]
struct NoPower;

impl NorFlashError for NoPower {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl Chip {
    fn new() -> Self {
        Self {
            bytes: std::vec![0xff; PAGE * PAGES],
            left: usize::MAX,
            erases: 0,
            noisy: false,
        }
    }

    /// Whether the next operation is carried out; the one during which the power is cut is carried out in part.
    fn step(&mut self) -> Result<bool, NoPower> {
        let before = self.left;
        self.left = before.saturating_sub(1);
        match before {
            0 => Err(NoPower),
            before => Ok(before > 1),
        }
    }
}

impl ErrorType for &mut Chip {
    type Error = NoPower;
}

impl ReadNorFlash for &mut Chip {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NoPower> {
        if self.left == 0 {
            return Err(NoPower);
        }
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        PAGE * PAGES
    }
}

impl NorFlash for &mut Chip {
    const WRITE_SIZE: usize = WORD;
    const ERASE_SIZE: usize = PAGE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NoPower> {
        for page in (from as usize..to as usize).step_by(PAGE) {
            let end = if self.step()? { PAGE } else { PAGE / 3 };
            self.bytes[page..page + end].fill(0xff);
            self.erases += 1;
        }
        if self.left == 0 { Err(NoPower) } else { Ok(()) }
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NoPower> {
        assert_eq!((offset as usize % WORD, bytes.len() % WORD), (0, 0));
        for (place, word) in (offset as usize..).step_by(WORD).zip(bytes.chunks(WORD)) {
            // In part: some of the bits are cleared.
            let spared = if self.step()? { 0 } else { 0x5a };
            for (to, from) in self.bytes[place..].iter_mut().zip(word) {
                let erased = *to & from == *from;
                assert!(erased || self.noisy, "a word that is not erased is written");
                *to &= from | spared;
            }
        }
        if self.left == 0 { Err(NoPower) } else { Ok(()) }
    }
}

parameters! {
    struct Calibration {
        zero: i32 = Parameter::<i32>::new(-1);
        gain: f32 = Parameter::<f32>::new(1.0).range(0.0, 1000.0);
        label: Text<24> = Parameter::<Text<24>>::new("");
    }
}

struct Part(Calibration);

impl Component for Part {
    fn offer(&self) -> Offer<'_> {
        Offer::new("part")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn poll(&mut self, _: Instant, _: &mut Report<'_>) -> Run {
        Run::Completed
    }

    fn abort(&mut self, _: Instant) {}

    fn make_safe(&mut self, _: Instant) {}
}

impl Tunable for Part {
    const PARAMETERS: &'static [Declaration] = Calibration::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.0.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.0.set(index, value);
    }
}

/// The firmware after a start.
fn start(chip: &mut Chip) -> Tuned<(Part,), (), Flash<&mut Chip>, 3> {
    let flash = Flash::new(chip, 0..(PAGE * PAGES) as u32).expect("the borders of pages");
    Tuned::new((Part(Calibration::default()),)).load(flash)
}

/// The values, and what a restart makes of them.
fn values(tuned: &impl Tuning) -> [String; 3] {
    [0, 1, 2].map(|index| {
        let parameter = tuned.parameter(index).expect("there are three");
        assert_eq!(parameter.kept, Kept::Saved);
        format!("{:?}", parameter.value)
    })
}

/// Sets all values to those of a round, and saves them.
fn change(chip: &mut Chip, round: i32) -> Result<(), SaveError> {
    let mut tuned = start(chip);
    let label = format!("round {round} of this test");
    let set = [
        Value::I32(round),
        Value::F32(round as f32 / 4.0),
        Value::Text(&label),
    ];
    for (index, value) in set.into_iter().enumerate() {
        tuned.set(index as u8, value).expect("it fits");
    }
    tuned.save()
}

fn of_round(round: i32) -> [String; 3] {
    [
        format!("I32({round})"),
        format!("F32({:?})", round as f32 / 4.0),
        format!("Text({:?})", format!("round {round} of this test")),
    ]
}

#[test]
fn a_power_cut_at_any_write_leaves_the_old_or_the_new_value() {
    let mut chip = Chip::new();
    change(&mut chip, 0).expect("it has power");
    let (mut cuts, mut mixed) = (0, 0);
    for round in 1..40 {
        let (old, new) = (of_round(round - 1), of_round(round));
        for left in 1.. {
            let mut cut = chip.clone();
            cut.left = left;
            let saved = change(&mut cut, round);
            if cut.left > 0 {
                // The power was there to the end.
                saved.expect("it has power");
                chip = cut;
                break;
            }
            cuts += 1;
            cut.left = usize::MAX;
            let after = values(&start(&mut cut));
            for (value, (old, new)) in after.iter().zip(old.iter().zip(&new)) {
                let known = value == old || value == new;
                assert!(
                    known,
                    "round {round}, cut {left}: {value}, not {old} or {new}"
                );
            }
            mixed += usize::from(after != old && after != new);
            // And the storage works on.
            change(&mut cut, 1000 + round).expect("it has power");
            assert_eq!(values(&start(&mut cut)), of_round(1000 + round));
        }
        assert_eq!(values(&start(&mut chip)), of_round(round));
    }
    assert!(
        cuts >= 500 && mixed > 0 && chip.erases >= 5,
        "{cuts} {mixed} {}",
        chip.erases
    );
}

#[test]
fn any_content_of_the_flash_is_read_and_can_be_written_over() {
    let mut random = 1u32;
    for round in 0..200 {
        let mut chip = Chip::new();
        change(&mut chip, 0).expect("it has power");
        chip.noisy = true;
        // A few bytes of noise, or nothing but noise.
        let count = if round % 4 == 0 { PAGE * PAGES } else { 4 };
        for at in 0..count {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let place = if count > 4 { at } else { random as usize >> 8 };
            let place = place % (PAGE * PAGES);
            chip.bytes[place] = (random >> 24) as u8;
        }
        drop(start(&mut chip));
        change(&mut chip, 1).expect("it has power");
        assert_eq!(values(&start(&mut chip)), of_round(1), "round {round}");
    }
    for fill in [0x00, 0x55, 0xff] {
        let mut chip = Chip::new();
        chip.noisy = true;
        chip.bytes.fill(fill);
        change(&mut chip, 1).expect("it has power");
        assert_eq!(values(&start(&mut chip)), of_round(1), "{fill:#x}");
    }
}

#[test]
fn addresses_that_are_not_the_borders_of_pages_are_refused() {
    for addresses in [1..1024, 0..1000, 0..512] {
        assert!(Flash::new(&mut Chip::new(), addresses).is_none());
    }
}
