//! Counts the cycles of code on a Cortex-M0: QEMU traces the instructions, a table says how many cycles each takes.
//!
//! QEMU does not count cycles. The table is from the Cortex-M0's Technical Reference Manual (r0p0, table 3-1), for flash
//! without wait states and a single-cycle multiplier, as in the nRF51. It leaves out the wait states of the UART's bus.

use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use xshell::cmd;

use crate::image::{self, Memory};
use crate::project::{Project, marked};

/// Counting starts and stops at the first two functions of the image; the third is the interrupt handler.
const BEGIN: &str = "count_begin";
const END: &str = "count_end";
const INTERRUPT: &str = "on_uart";

/// Cycles to enter an interrupt, and to leave it.
const ENTER_AND_LEAVE: u64 = 16 + 16;

/// The README that shows the cycles, between marks.
const README: &str = "examples/firmware/README.md";

/// Counts the cycles of this image. Checks that it keeps up with 1 Mbaud, and that the README shows the counts. The last of
/// them is the longest critical section, also of another image, which was made for that.
pub(crate) fn check(project: &Project, image: &Path, masked: &Path) -> Result<()> {
    let mut counts = count(project, image)?;
    let others = count(project, masked)?;
    println!("\nWhat may mask interrupts:\n\n{}", table(&others));
    if let (Some(longest), Some(other)) = (counts.last_mut(), others.last())
        && other.cycles > longest.cycles
    {
        longest.clone_from(other);
    }
    println!("\nA Cortex-M0, optimised for size:\n\n{}\n", table(&counts));
    println!("{}", rate(&counts)?);
    let readme = project.sh.read_file(README)?;
    ensure!(
        shows(&readme, &counts),
        "{README} shows other cycles; expected between <!-- cycles --> and <!-- /cycles -->:\n\n{}",
        table(&counts)
    );
    Ok(())
}

fn table(counts: &[Count]) -> String {
    let row = |Count {
                   what,
                   cycles,
                   instructions,
               }: &Count| { format!("\n| {what} | {cycles} | {instructions} |") };
    let rows: String = counts.iter().map(row).collect();
    format!("| | cycles | instructions |\n|---|---|---|{rows}")
}

/// Cycles between two bytes at 1 Mbaud and 16 MHz.
const PAUSE: u64 = 160;

/// Capacity of the images' receive queue in bytes.
const QUEUE: u64 = 128;

/// Bytes that one turn of the main loop reads, at most.
const READ: u64 = 256;

/// Cycles for which our code masks interrupts, at most: a promise of `ztl_mcu::shared`.
const MASKED: u64 = 1000;

/// The line rate that the image keeps up with. The first three counts add up to a received byte. The fourth is the start
/// of a task, during which no byte leaves the queue. The last two are an idle turn and the longest critical section.
fn rate(counts: &[Count]) -> Result<String> {
    let cycles: Vec<u64> = counts.iter().map(|count| count.cycles).collect();
    let &[interrupt, queue, node, start, .., turn, masked] = cycles.as_slice() else {
        bail!("the image measured too few things");
    };
    ensure!(
        masked <= MASKED,
        "a critical section takes {masked} cycles: expected at most {MASKED}"
    );
    let byte = interrupt + queue + node;
    let left = PAUSE.saturating_sub(byte);
    let caught_up = turn.checked_div(left).unwrap_or(u64::MAX);
    let waiting = (start + turn) / PAUSE;
    ensure!(
        caught_up <= READ && waiting <= QUEUE,
        "too slow for 1 Mbaud at 16 MHz: a byte arrives every {PAUSE} cycles and takes {byte}; {waiting} arrive while a \
         task starts (the queue holds {QUEUE}); a turn needs {caught_up} bytes to catch up (it reads {READ})"
    );
    Ok(format!(
        "At 16 MHz a received byte takes {byte} of its {PAUSE} cycles at 1 Mbaud: a margin of {} %, enough for {} kbaud.\n\
         {waiting} bytes arrive while a task starts; the queue holds {QUEUE}. A turn needs {caught_up} bytes to catch up.",
        left * 100 / PAUSE,
        16_000 * 10 / byte,
    ))
}

/// Accepted deviation from the README in percent, for other compilers.
const TOLERANCE: u64 = 10;

/// Whether the README shows these counts between its marks.
fn shows(readme: &str, counts: &[Count]) -> bool {
    let [_, shown, _] = marked(readme, "cycles").unwrap_or_default();
    let row = |line: &str| -> Option<(String, u64)> {
        let mut cells = line.split('|').map(str::trim);
        let what = cells.nth(1)?.to_owned();
        Some((what, cells.next()?.parse().ok()?))
    };
    let rows: Vec<_> = shown.lines().filter_map(row).collect();
    let near = |(what, cycles): &(String, u64), count: &Count| {
        *what == count.what && cycles.abs_diff(count.cycles) * 100 <= cycles * TOLERANCE
    };
    let is_shown = |count: &Count| rows.iter().any(|row| near(row, count));
    rows.len() == counts.len() && counts.iter().all(is_shown)
}

/// The cycles of one thing that the image does.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Count {
    what: String,
    cycles: u64,
    instructions: u64,
}

/// Instructions and cycles.
#[derive(Debug, Default, Clone, Copy, PartialEq, Eq)]
struct Sum {
    instructions: u64,
    cycles: u64,
}

impl Sum {
    const fn add(&mut self, cycles: u64) {
        self.instructions += 1;
        self.cycles += cycles;
    }
}

/// `CPSID i`, which begins a critical section.
const MASK: u16 = 0xB672;

/// Runs an image on the micro:bit, and sends it one byte over its UART. The image prints a line for each thing that it
/// does: how often, and a name. Returns the counts, the interrupt first, the longest critical section last.
fn count(project: &Project, path: &Path) -> Result<Vec<Count>> {
    let sh = &project.sh;
    let trace = project.target.join("cycles.trace");
    // A second is enough; the limit leaves room for a busy machine.
    let run = cmd!(
        sh,
        "timeout 120 qemu-system-arm -M microbit -nographic -monitor none -semihosting -serial stdio
         -singlestep -d exec,nochain -D {trace} -kernel {path}"
    );
    println!("$ {run}");
    let output = run.stdin("x").read()?;
    let trace = sh.read_file(trace)?;
    counts(&image::memory(path)?, &addresses(&trace)?, &output)
}

/// The address of each instruction, in order.
fn addresses(trace: &str) -> Result<Vec<u32>> {
    // Trace 0: 0x7f2594000240 [00800400/0000199a/00000510/ff000201] SysTick
    let address = |line: &str| {
        let (_, rest) = line.split_once('[')?;
        u32::from_str_radix(rest.split('/').nth(1)?, 16).ok()
    };
    let wrong = |line: &str| format!("QEMU's trace has no address: {line}");
    let address = |line| address(line).with_context(|| wrong(line));
    let lines = trace.lines().filter(|line| line.starts_with("Trace "));
    lines.map(address).collect()
}

fn counts(memory: &Memory, addresses: &[u32], output: &str) -> Result<Vec<Count>> {
    let function = |name: &str| {
        let function = memory.function(name);
        function.with_context(|| format!("the image has no function `{name}`"))
    };
    let (begin, end, interrupt) = (function(BEGIN)?, function(END)?, function(INTERRUPT)?);
    let (mut regions, mut region) = (Vec::new(), None::<Sum>);
    let (mut entered, mut within) = (Sum::default(), false);
    let (mut masked, mut depth, mut longest) = (Sum::default(), 0u32, Sum::default());
    for (address, next) in addresses.iter().zip(addresses.iter().skip(1)) {
        if *address == begin.start {
            region = Some(Sum::default());
        } else if *address == end.start {
            regions.extend(region.take());
        }
        let cycles = cycles(memory, *address, *next)?;
        within |= *address == interrupt.start && entered.cycles == 0;
        if within {
            entered.add(cycles);
        } else if let Some(region) = &mut region {
            region.add(cycles);
        }
        depth += u32::from(halfword(memory, *address)? == MASK);
        if depth > 0 {
            masked.add(cycles);
        }
        if depth > 0 && unmasks(memory, *address) {
            depth -= 1;
        }
        if depth == 0 {
            let ended = std::mem::take(&mut masked);
            if ended.cycles > longest.cycles {
                longest = ended;
            }
        }
        // Calls within the handler also return.
        within &= !(interrupt.contains(address) && returns(memory, *address));
    }
    entered.cycles += ENTER_AND_LEAVE;
    // The first region is empty: it measures the counting itself.
    let regions = regions.split_first();
    let (nothing, regions) = regions.context("the image measured nothing")?;
    let lines = output.lines().filter(|line| !line.trim().is_empty());
    let lines: Vec<&str> = lines.collect();
    let same = regions.len() + 1 == lines.len();
    ensure!(
        same,
        "the image printed other lines than it measured:\n{output}"
    );
    let sums = regions.iter().map(|region| Sum {
        instructions: region.instructions.saturating_sub(nothing.instructions),
        cycles: region.cycles.saturating_sub(nothing.cycles),
    });
    let counted = lines.iter().zip(std::iter::once(entered).chain(sums));
    let masked = std::iter::once(("1 interrupts masked, at most", longest));
    let counted = counted.map(|(line, sum)| (*line, sum)).chain(masked);
    counted.map(|(line, sum)| named(line, sum)).collect()
}

/// Parses `120 a byte into the queue`, and divides by that number with rounding.
fn named(line: &str, sum: Sum) -> Result<Count> {
    let parse = || {
        let (times, what) = line.trim().split_once(' ')?;
        let times: u64 = times.parse().ok()?;
        let each = |sum: u64| (sum + times / 2).checked_div(times);
        let (cycles, instructions) = (each(sum.cycles)?, each(sum.instructions)?);
        let what = what.to_owned();
        Some(Count {
            what,
            cycles,
            instructions,
        })
    };
    let expected = "expected a number and a name";
    parse().with_context(|| format!("invalid line `{line}` of the image: {expected}"))
}

fn halfword(memory: &Memory, address: u32) -> Result<u16> {
    let code = memory.halfword(address);
    code.with_context(|| format!("the image has no code at {address:#x}"))
}

/// `MSR PRIMASK`, which ends a critical section, also a nested one.
fn unmasks(memory: &Memory, address: u32) -> bool {
    let code = |address| memory.halfword(address).unwrap_or_default();
    code(address) & 0xFFF0 == 0xF380 && code(address + 2) == 0x8810
}

/// `POP {…, pc}` or `BX LR`.
fn returns(memory: &Memory, address: u32) -> bool {
    let code = memory.halfword(address).unwrap_or_default();
    code & 0xFF00 == 0xBD00 || code == 0x4770
}

/// The cycles of an instruction when the one at `next` follows.
fn cycles(memory: &Memory, address: u32, next: u32) -> Result<u64> {
    let code = halfword(memory, address)?;
    let listed = u64::from((code & 0xFF).count_ones());
    Ok(match code {
        // Writes the program counter; otherwise another register.
        0x4400..=0x46FF if code & 0x87 == 0x87 => 3,
        0x0000..=0x46FF => 1,
        0x4700..=0x47FF => 3,                                     // BX, BLX
        0x4800..=0x9FFF => 2,                                     // loads and stores
        0xB400..=0xB5FF => 1 + listed + u64::from(code >> 8 & 1), // PUSH
        0xBC00..=0xBCFF => 1 + listed,                            // POP
        0xBD00..=0xBDFF => 4 + listed + 1,                        // POP, the program counter too
        0xBF20 | 0xBF30 => 2,                                     // WFE, WFI
        0xA000..=0xBFFF => 1,
        0xC000..=0xCFFF => 1 + listed,               // several at once
        0xD000..=0xDFFF if next == address + 2 => 1, // a branch that is not taken
        0xD000..=0xE7FF => 3,
        // BL, and system instructions.
        0xE800..=0xFFFF => 4,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image with this code at 0x100.
    fn memory(code: &[u16], functions: &[(&str, u32, u32)]) -> Memory {
        let bytes = code.iter().flat_map(|code| code.to_le_bytes()).collect();
        let mut memory = Memory::default();
        memory.contents.push((0x100, bytes));
        for (name, start, end) in functions {
            memory.functions.push(((*name).to_owned(), *start..*end));
        }
        memory
    }

    #[test]
    fn instructions_take_the_cycles_of_the_manual() {
        for (code, taken, expected) in [
            (0x2001, false, 1), // MOVS r0, #1
            (0x4348, false, 1), // MULS r0, r1
            (0x4608, false, 1), // MOV r0, r1
            (0x4687, true, 3),  // MOV pc, r0
            (0x4770, true, 3),  // BX lr
            (0x4801, false, 2), // LDR r0, [pc, #4]
            (0x7008, false, 2), // STRB r0, [r1]
            (0xB510, false, 3), // PUSH {r4, lr}
            (0xBD10, true, 6),  // POP {r4, pc}
            (0xBC10, false, 2), // POP {r4}
            (0xC903, false, 3), // LDM r1!, {r0, r1}
            (0xD001, false, 1), // BEQ
            (0xD001, true, 3),
            (0xE7FE, true, 3),  // B
            (0xF000, true, 4),  // BL
            (0xF3EF, false, 4), // MRS
            (0xB672, false, 1), // CPSID i
        ] {
            let next = if taken { 0x200 } else { 0x102 };
            let counted = cycles(&memory(&[code], &[]), 0x100, next);
            assert_eq!(counted.unwrap(), expected, "{code:#x}");
        }
        assert!(cycles(&memory(&[], &[]), 0x100, 0x102).is_err());
    }

    #[test]
    fn the_cost_of_counting_is_subtracted() {
        let (begin, end) = (("count_begin", 0x100, 0x102), ("count_end", 0x102, 0x104));
        // BX lr; BX lr; MOVS, BX lr; LDR; CPSID, MSR PRIMASK.
        let code = "4770 4770 2001 4770 6808 b672 f380 8810".split(' ');
        let code: Vec<u16> = code
            .map(|code| u16::from_str_radix(code, 16).unwrap())
            .collect();
        let memory = memory(&code, &[begin, end, ("on_uart", 0x104, 0x108)]);
        let addresses = [
            0x104, 0x106, // the interrupt
            0x100, 0x102, // nothing
            0x100, 0x108, 0x108, 0x102, // two loads
            0x10A, 0x108, 0x108, 0x10C, // the same with interrupts masked
            0x10A, 0x108, 0x10A, 0x10C, 0x10C, 0x108, // and within one another
        ];
        let counts = counts(&memory, &addresses, "1 interrupt\n2 loads\n").unwrap();
        let count = |what: &str, cycles, instructions| {
            let what = what.to_owned();
            Count {
                what,
                cycles,
                instructions,
            }
        };
        let masked = count("interrupts masked, at most", 12, 5);
        let expected = [count("interrupt", 36, 2), count("loads", 2, 1), masked];
        assert_eq!(counts, expected);
        assert!(super::counts(&memory, &addresses, "1 interrupt\n").is_err());
    }

    #[test]
    fn a_trace_of_qemu_is_parsed() {
        let trace =
            "Trace 0: 0x7f2594000100 [00800400/0000004c/00000510/ff000201] Reset\nStopped\n";
        assert_eq!(addresses(trace).unwrap(), [0x4C]);
        assert!(addresses("Trace 0: x").is_err());
    }

    fn counted(cycles: &[u64]) -> Vec<Count> {
        let count = |cycles: &u64| {
            let (what, cycles) = (format!("thing of {cycles}"), *cycles);
            Count {
                what,
                cycles,
                instructions: 1,
            }
        };
        cycles.iter().map(count).collect()
    }

    #[test]
    fn a_rate_follows_from_the_counts() {
        let text = rate(&counted(&[70, 20, 38, 8000, 3000, 1600, 1000])).unwrap();
        for part in [
            "takes 128 of its 160",
            "20 %, enough for 1250 kbaud",
            "60 bytes arrive",
            "needs 50 bytes",
        ] {
            assert!(text.contains(part), "{text}");
        }
        for slow in [
            [100, 20, 40, 8000, 1600, 1000],
            [70, 20, 38, 20_000, 1600, 1000],
            [70, 20, 68, 8000, 1600, 1000],
            [70, 20, 38, 8000, 1600, 1001],
        ] {
            assert!(rate(&counted(&slow)).is_err(), "{slow:?}");
        }
        assert!(rate(&counted(&[100])).is_err());
    }

    #[test]
    fn a_readme_with_other_counts_is_rejected() {
        let readme = |table: &str| format!("x\n<!-- cycles -->\n{table}\n<!-- /cycles -->\n");
        let now = counted(&[100, 30]);
        assert!(shows(&readme(&table(&now)), &now));
        let near = table(&now).replace("| 100 |", "| 92 |");
        assert!(shows(&readme(&near), &now));
        let far = table(&now).replace("| 100 |", "| 90 |");
        for wrong in [far, table(&counted(&[100])), table(&counted(&[100, 30, 5]))] {
            assert!(!shows(&readme(&wrong), &now), "{wrong}");
        }
        assert!(!shows("x", &now));
    }
}
