//! `ztl line`: a bad cable between two ends, or a shared line between several.

use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::ValueEnum;
use ztl_sim::line::{Cable, CableError, End, Faults, FaultyLine, SharedCable};
use ztl_std::gateway::BAUD;

use crate::exit::Done;
use crate::option_values::duration;
use crate::signals;
use crate::terminal::{is_live, line, rewrite};

/// How often the counts are shown on a terminal.
const SHOW: Duration = Duration::from_secs(1);
/// Names of the ends.
const NAMES: [&str; 32] = [
    "A", "B", "C", "D", "E", "F", "G", "H", "I", "J", "K", "L", "M", "N", "O", "P", "Q", "R", "S",
    "T", "U", "V", "W", "X", "Y", "Z", "27", "28", "29", "30", "31", "32",
];

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER_HELP)]
pub(crate) struct Line {
    /// One end: pty, pty:LINK, serial:PATH?baud=115200, tcp:HOST:PORT, tcp-listen:PORT, sim:gripper
    #[arg(value_name = "A")]
    a: End,

    /// The other end
    #[arg(value_name = "B")]
    b: End,

    /// More ends of a shared line, up to 30
    #[arg(value_name = "C", num_args = 0..=30, requires = "half_duplex")]
    others: Vec<End>,

    /// A shared, half-duplex line such as RS-485: each end hears what the others send, and ends that send at once damage each
    /// other's bytes
    #[arg(long, conflicts_with = "cut")]
    half_duplex: bool,

    /// Bits per second, ten per byte, as on a UART [default: unlimited; 115200 with --half-duplex]
    #[arg(long, value_name = "RATE", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,

    /// Delay of each byte
    #[arg(long, value_name = "TIME", default_value = "0s", value_parser = duration)]
    latency: Duration,

    /// Probability that a bit is flipped, such as 1e-4
    #[arg(long, value_name = "P", default_value = "0", value_parser = probability)]
    flip: f64,

    /// Probability that a byte is lost
    #[arg(long, value_name = "P", default_value = "0", value_parser = probability)]
    drop: f64,

    /// Probability that a byte is duplicated
    #[arg(long, value_name = "P", default_value = "0", value_parser = probability)]
    double: f64,

    /// Probability, for each byte, that the line stalls
    #[arg(long, value_name = "P", default_value = "0", value_parser = probability)]
    stall: f64,

    /// Longest stall; each has a random length
    #[arg(long, value_name = "TIME", default_value = "500ms", value_parser = duration)]
    stall_for: Duration,

    /// Lose all bytes in this direction
    #[arg(long, value_name = "WAY")]
    cut: Option<Cut>,

    /// Cut only after this time
    #[arg(long, value_name = "TIME", default_value = "0s", value_parser = duration, requires = "cut")]
    cut_after: Duration,

    /// Cut only for this time [default: until the end]
    #[arg(long, value_name = "TIME", value_parser = duration, requires = "cut")]
    cut_for: Option<Duration>,

    /// Seed of the random numbers: the same seed and bytes have the same faults [default: random]
    #[arg(long, value_name = "NUMBER")]
    seed: Option<u64>,

    /// End after this time [default: at Ctrl-C]
    #[arg(long = "for", value_name = "TIME", value_parser = duration)]
    limit: Option<Duration>,
}

const AFTER_HELP: &str = "\
A TIME has a unit: 500ms, 2s, 1m. Faults occur in both directions, independently; on a shared line, in what each end
hears.
Byte counts are printed at the end, at each SIGUSR1, and continuously on a terminal.

A gripper behind a bad cable:
  ztl device sim:gripper --on tcp:7000
  ztl line pty:/tmp/gripper tcp:localhost:7000 --baud 115200 --flip 1e-4
  ztl gateway --device gripper=serial:/tmp/gripper -p 12345 -s /lab

Two boards on one pair of wires:
  ztl line --half-duplex pty:/tmp/arm serial:/dev/ttyUSB0 serial:/dev/ttyUSB1
  ztl gateway --device arm=rs485:/tmp/arm -p 12345 -s /lab";

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Cut {
    /// What B sends is lost
    ToA,
    /// What A sends is lost
    ToB,
    /// All bytes are lost
    Both,
}

fn probability(text: &str) -> Result<f64, &'static str> {
    let number = text.parse().ok();
    number
        .filter(|number| (0.0..=1.0).contains(number))
        .ok_or("expected a number from 0 to 1, such as 0.001 or 1e-4")
}

impl Line {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        let seed = self.seed.unwrap_or_else(ztl_sim::line::random_seed);
        let limit = self.limit.map(|limit| Instant::now() + limit);
        let cable = Arc::new(self.lay(seed)?);
        for (name, address) in NAMES.iter().zip(cable.addresses()) {
            line(format_args!("{name}: {address}"));
        }
        line(format_args!(
            "Seed {seed}: with --seed {seed} the same bytes have the same faults."
        ));
        let shown = Arc::downgrade(&cable);
        signals::at_usr1(move || {
            if let Some(cable) = shown.upgrade() {
                cable.print();
            }
        })?;
        let live = is_live();
        loop {
            let left = limit.map(|limit| limit.saturating_duration_since(Instant::now()));
            let pause = if live { SHOW } else { Duration::MAX };
            let wait = left.map_or(pause, |left| left.min(pause));
            if signals::wait_for(wait) || left.is_some_and(|left| left.is_zero()) {
                break;
            }
            if live {
                cable.show();
            }
        }
        if live {
            rewrite("", "");
        }
        cable.print();
        Ok(signals::exit_code_or(ExitCode::SUCCESS))
    }

    fn lay(self, seed: u64) -> Result<Laid, CableError> {
        let lines = [
            self.direction(seed, Cut::ToB),
            self.direction(!seed, Cut::ToA),
        ];
        if !self.half_duplex {
            return Ok(Laid::Cable(Cable::lay([self.a, self.b], lines)?));
        }
        let faults = self.faults();
        let mut ends = vec![self.a, self.b];
        ends.extend(self.others);
        let baud = self.baud.unwrap_or(BAUD);
        let cable = SharedCable::lay(ends, baud, (faults, self.latency), seed)?;
        Ok(Laid::Shared(cable))
    }

    const fn faults(&self) -> Faults {
        Faults {
            flip: self.flip,
            drop: self.drop,
            double: self.double,
            stall: self.stall,
            stall_for: self.stall_for,
        }
    }

    /// One direction; `way` is the option that cuts it.
    fn direction(&self, seed: u64, way: Cut) -> FaultyLine {
        let line = FaultyLine::new(self.faults(), seed)
            .with_baud(self.baud.unwrap_or(0))
            .with_latency(self.latency);
        match self.cut {
            Some(cut) if cut == way || cut == Cut::Both => {
                line.with_cut(self.cut_after, self.cut_for.unwrap_or(Duration::MAX))
            }
            _ => line,
        }
    }
}

/// A running line.
enum Laid {
    Cable(Cable),
    Shared(SharedCable),
}

impl Laid {
    fn addresses(&self) -> Vec<&str> {
        match self {
            Self::Cable(cable) => cable.addresses().to_vec(),
            Self::Shared(cable) => cable.addresses().iter().map(String::as_str).collect(),
        }
    }

    fn print(&self) {
        match self {
            Self::Cable(cable) => {
                let [there, back] = cable.counts();
                line(format_args!("A to B: {there}"));
                line(format_args!("B to A: {back}"));
            }
            Self::Shared(cable) => {
                for (name, heard) in NAMES.iter().zip(cable.counts()) {
                    line(format_args!("to {name}: {heard}"));
                }
                line(format_args!("{} bytes collided", cable.collided()));
            }
        }
    }

    /// Shows the counts in one line that is overwritten.
    fn show(&self) {
        let text = match self {
            Self::Cable(cable) => {
                let [there, back] = cable.counts();
                format!(
                    "A to B: {} bytes, {} faults; B to A: {} bytes, {} faults",
                    there.bytes,
                    there.faults(),
                    back.bytes,
                    back.faults()
                )
            }
            Self::Shared(cable) => {
                let counts = cable.counts();
                let heard = counts.first().copied().unwrap_or_default();
                format!(
                    "to A: {} bytes, {} faults; {} bytes collided",
                    heard.bytes,
                    heard.faults(),
                    cable.collided()
                )
            }
        };
        rewrite(&text, "");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_a_unit() {
        assert_eq!(duration("500ms"), Ok(Duration::from_millis(500)));
        assert_eq!(duration("2m"), Ok(Duration::from_secs(120)));
        for wrong in ["", "2", "s", "-1s", "1e9s", "99999999999999999999s"] {
            assert!(duration(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn probabilities_are_from_0_to_1() {
        assert_eq!(probability("1e-4"), Ok(0.0001));
        assert_eq!(probability("1"), Ok(1.0));
        for wrong in ["", "-0.1", "1.1", "NaN", "10%", "inf"] {
            assert!(probability(wrong).is_err(), "{wrong}");
        }
    }
}
