//! The project's development tasks, run as `cargo xtask COMMAND`.

mod bare;
mod beside;
mod capi;
#[cfg(test)]
mod circles;
mod cross;
mod cycles;
mod deb;
mod dist;
mod firmware;
mod fuzz;
mod image;
mod install;
mod lock;
mod long_runs;
mod package;
mod paths;
mod project;
mod proof;
mod rerun;
mod size;
mod stalls;
mod steps;
mod zig;

use std::process::ExitCode;

use clap::Parser;
use clap::builder::PossibleValuesParser;

use project::Project;

/// The project's development tasks.
#[derive(Parser)]
#[command(bin_name = "cargo xtask")]
enum XtaskCommand {
    /// Install what the tests need: programs, the original package, other peers.
    Setup,
    /// Check format and lints, run unit tests and wire tests: before each commit.
    Check,
    /// Check and test everything, installing what is missing.
    Test {
        /// List the steps.
        #[arg(long)]
        list: bool,
        /// Run only this step; repeatable.
        #[arg(long, value_name = "STEP", value_parser = PossibleValuesParser::new(steps::names()))]
        only: Vec<String>,
    },
    /// Build the C libraries.
    C {
        /// Processors of `cargo xtask dist`, or targets of microcontrollers; otherwise this machine.
        targets: Vec<String>,
        /// Also run them.
        #[arg(long)]
        check: bool,
        /// Build the shared library, for old versions of glibc.
        #[arg(long, requires = "targets")]
        glibc: bool,
    },
    /// Build static `ztl` programs for old robots.
    Dist {
        /// Processors; otherwise all.
        targets: Vec<String>,
        /// Also run them, and the C libraries for them.
        #[arg(long)]
        check: bool,
        /// Build `ztl-fleet` instead; without processors for x86_64 and aarch64.
        #[arg(long)]
        fleet: bool,
    },
    /// Build Debian packages of static `ztl` programs.
    Deb {
        /// Processors of `cargo xtask dist`; otherwise this machine's.
        targets: Vec<String>,
    },
    /// Build the images of examples/firmware.
    Firmware {
        /// Only for this board.
        board: Option<String>,
    },
    /// Run a board's image in QEMU and print how to reach it.
    Qemu {
        board: String,
        /// TCP port of its serial line.
        #[arg(default_value_t = 5555)]
        port: u16,
    },
    /// Compare the size of firmware images with the record.
    Size {
        /// Rewrite the record.
        #[arg(long)]
        accept: bool,
    },
    /// Search for inputs that break a promise.
    Fuzz {
        /// Only this target.
        target: Option<String>,
        /// For each target.
        #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
        seconds: u32,
    },
    /// Explore all faults on the link.
    #[command(disable_help_flag = true)]
    Model {
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Simulate whole laboratories with faults.
    #[command(disable_help_flag = true)]
    Simulate {
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        args: Vec<String>,
    },
    /// Run many tasks and resets with real processes.
    Soak(long_runs::Soak),
    /// Cut the power of a board at each change of its flash during an update, a part of them in each run.
    Cuts(long_runs::Cuts),
    /// Compare performance with the original.
    Bench {
        /// `firmware`, or parts of the server comparison; otherwise all.
        #[arg(value_parser = PossibleValuesParser::new(long_runs::PARTS))]
        parts: Vec<String>,
    },
}

fn main() -> ExitCode {
    match run(XtaskCommand::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("\nxtask: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(command: XtaskCommand) -> anyhow::Result<()> {
    let project = &Project::enter()?;
    match command {
        XtaskCommand::Setup => steps::install(project),
        XtaskCommand::Check => steps::check(project),
        XtaskCommand::Test { list: true, .. } => {
            steps::list();
            Ok(())
        }
        XtaskCommand::Test { only, .. } => steps::test(project, &only),
        XtaskCommand::C {
            targets,
            check,
            glibc,
        } => capi::build(project, &targets, check, glibc),
        XtaskCommand::Dist {
            targets,
            check,
            fleet: false,
        } => dist::build(project, &targets, check),
        XtaskCommand::Dist { targets, check, .. } => dist::build_fleet(project, &targets, check),
        XtaskCommand::Deb { targets } => deb::build(project, &targets).map(drop),
        XtaskCommand::Firmware { board } => firmware::show(project, board.as_deref()),
        XtaskCommand::Qemu { board, port } => firmware::run_in_qemu(project, &board, port),
        XtaskCommand::Size { accept: true } => size::accept(project),
        XtaskCommand::Size { accept: false } => size::check(project),
        XtaskCommand::Fuzz { target, seconds } => fuzz::search(project, target.as_deref(), seconds),
        XtaskCommand::Model { args } => long_runs::simulation(project, "model", &args),
        XtaskCommand::Simulate { args } => long_runs::simulation(project, "simulate", &args),
        XtaskCommand::Soak(soak) => soak.run(project),
        XtaskCommand::Cuts(cuts) => cuts.run(project),
        XtaskCommand::Bench { parts } => long_runs::bench(project, &parts),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn each_command_has_one_line_of_help() {
        XtaskCommand::command().debug_assert();
        for command in XtaskCommand::command().get_subcommands() {
            assert!(command.get_about().is_some(), "{}", command.get_name());
        }
    }

    #[test]
    fn a_simulation_gets_its_own_options() {
        let words = ["xtask", "model", "--depth", "2"];
        let Ok(XtaskCommand::Model { args }) = XtaskCommand::try_parse_from(words) else {
            panic!("rejected");
        };
        assert_eq!(args, ["--depth", "2"]);
    }

    #[test]
    fn a_wrong_argument_is_rejected_with_the_valid_ones() {
        for (words, expected) in [
            ("test --only fmd", "clippy"),
            ("soak --tasks 0", "0 is not in 10.."),
            ("bench nothing", "firmware"),
            ("c --glibc", "<TARGETS>"),
            ("fuzz --seconds 0", "--seconds"),
        ] {
            let words = ["xtask"].into_iter().chain(words.split(' '));
            let Err(error) = XtaskCommand::try_parse_from(words) else {
                panic!("accepted");
            };
            assert!(error.to_string().contains(expected), "{error}");
        }
    }
}
