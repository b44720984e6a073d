//! `ztl firmware`: images of firmware that devices take over their link (`docs/update.md`).

mod sign;
mod update;

pub(crate) use sign::read_key;

use crate::exit::Done;

#[derive(Debug, clap::Args)]
pub(crate) struct Firmware {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Create a key pair, to sign images
    Keygen(sign::Keygen),
    /// Sign an image, and write the file for the update to stdout
    Sign(sign::Sign),
    /// Show for which board a signed image is, and its version; with -k, verify it
    Show(sign::Show),
    /// Update a device of a gateway over its link
    Update(update::Update),
}

impl Firmware {
    pub(crate) fn run(self) -> Done {
        match self.action {
            Action::Keygen(keygen) => keygen.run(),
            Action::Sign(sign) => sign.run(),
            Action::Show(show) => show.run(),
            Action::Update(update) => update.run(),
        }
    }
}
