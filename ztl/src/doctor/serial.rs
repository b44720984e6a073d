//! Checks serial ports: which exist, whether this user may open them, and which process has them open. Opens
//! none of them, because that would reset many boards.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::Access;
use serde_json::json;

use super::finding::Finding;

/// Prefixes of ports to list. `ttyS` is not one of them: there are always four.
const NAMES: [&str; 6] = ["ttyACM", "ttyUSB", "ttyAMA", "ttyTHS", "ttySAC", "ttymxc"];

/// Probes every new port for a modem.
const MODEM_MANAGER: &str = "ModemManager";

pub(super) fn ports(wished: &[PathBuf]) -> Vec<Finding> {
    let known = stable_names();
    let users = users();
    let one = |path: &PathBuf, is_wished: bool| port(path, is_wished, &known, &users);
    if !wished.is_empty() {
        return wished.iter().map(|path| one(path, true)).collect();
    }
    let entries = fs::read_dir("/dev").into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries
        .filter(|entry| {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            NAMES.iter().any(|begin| name.starts_with(begin))
        })
        .map(|entry| entry.path())
        .collect();
    found.sort();
    if found.is_empty() {
        return vec![
            Finding::note("serial", "no port found, neither USB nor built in")
                .with_remedy("if a device is plugged in, see the end of `dmesg`; for another port, use `ztl doctor --serial /dev/ttyS0`"),
        ];
    }
    found.iter().map(|path| one(path, false)).collect()
}

fn port(
    path: &Path,
    is_wished: bool,
    names: &BTreeMap<PathBuf, String>,
    users: &BTreeMap<PathBuf, Vec<String>>,
) -> Finding {
    let shown = path.display();
    let (real, about) = match fs::canonicalize(path).and_then(|real| {
        let about = fs::metadata(&real)?;
        Ok((real, about))
    }) {
        Ok(found) => found,
        Err(error) => {
            return Finding::problem(
                "serial",
                format!("{shown}: {error}"),
                "is it plugged in? `ztl doctor` lists all ports; `dmesg` shows what the kernel detected",
            );
        }
    };
    if !about.file_type().is_char_device() || !is_terminal(&real) {
        return Finding::problem(
            "serial",
            format!("{shown} is not a serial port"),
            "`ztl doctor` without --serial lists all ports",
        );
    }
    let group = name_of("/etc/group", about.gid());
    let mode = about.permissions().mode() & 0o777;
    let stable = names.get(&real);
    let mut text = format!("{shown}, group {group}, mode {mode:o}");
    if let Some(stable) = stable {
        text += &format!(", also {stable}");
    }
    let others = users.get(&real).cloned().unwrap_or_default();
    let data =
        json!({ "path": shown.to_string(), "stable": stable, "group": group, "used_by": others });
    if let Err(error) = rustix::fs::access(path, Access::READ_OK | Access::WRITE_OK) {
        let user = name_of("/etc/passwd", rustix::process::getuid().as_raw());
        // Users should not join the superuser's group for this.
        let remedy = match group.as_str() {
            "root" | "0" => format!("run as root: `chgrp dialout {shown} && chmod 660 {shown}`"),
            group => format!("run as root: `usermod -a -G {group} {user}`, then log in again"),
        };
        let text = format!("{text}: permission denied for {user} ({error})");
        return Finding::problem("serial", text, remedy).with(data);
    }
    if !others.is_empty() {
        let who = others.join(", ");
        let text = format!("{text}: opened by {who}");
        let remedy = match others.iter().any(|other| other.contains(MODEM_MANAGER)) {
            true => {
                "`systemctl disable --now ModemManager`, or a udev rule with ENV{ID_MM_DEVICE_IGNORE}=\"1\""
            }
            false => "stop that program; two readers on one port take each other's bytes",
        };
        return match is_wished {
            true => Finding::problem("serial", text, remedy),
            // Not a problem: it may be a running gateway.
            false => Finding::note("serial", text),
        }
        .with(data);
    }
    Finding::good("serial", text).with(data)
}

/// Whether the kernel treats it as a terminal; assumed if the kernel does not say.
fn is_terminal(port: &Path) -> bool {
    let known = Path::new("/sys/class/tty");
    let name = port.file_name().unwrap_or_default();
    !known.exists() || known.join(name).exists() || port.starts_with("/dev/pts")
}

/// Stable names of ports, independent of where the device is plugged in.
fn stable_names() -> BTreeMap<PathBuf, String> {
    let entries = fs::read_dir("/dev/serial/by-id")
        .into_iter()
        .flatten()
        .flatten();
    entries
        .filter_map(|entry| {
            let port = fs::canonicalize(entry.path()).ok()?;
            Some((port, entry.path().display().to_string()))
        })
        .collect()
}

/// Which processes have which terminals open, as far as this user may see.
fn users() -> BTreeMap<PathBuf, Vec<String>> {
    let mut users: BTreeMap<PathBuf, Vec<String>> = BTreeMap::new();
    for process in fs::read_dir("/proc").into_iter().flatten().flatten() {
        let name = process.file_name();
        let Some(id) = name.to_str().and_then(|name| name.parse::<u32>().ok()) else {
            continue;
        };
        for file in fs::read_dir(process.path().join("fd"))
            .into_iter()
            .flatten()
            .flatten()
        {
            let Ok(path) = fs::read_link(file.path()) else {
                continue;
            };
            if path.starts_with("/dev") && path.to_string_lossy().contains("tty") {
                let program = fs::read_to_string(process.path().join("comm")).unwrap_or_default();
                let user = format!("{} ({id})", program.trim());
                let list = users.entry(path).or_default();
                if !list.contains(&user) {
                    list.push(user);
                }
            }
        }
    }
    users
}

/// Looks up the name of a user or group in a file of lines `name:x:ID:…`.
fn name_of(file: &str, id: u32) -> String {
    let text = fs::read_to_string(file).unwrap_or_default();
    let mut lines = text.lines().map(|line| line.split(':'));
    let found = lines.find_map(|mut fields| {
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(id)).then(|| name.to_owned())
    });
    found.unwrap_or_else(|| id.to_string())
}
