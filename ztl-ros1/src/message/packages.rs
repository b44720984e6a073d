//! Where the robot's ROS keeps its packages.

use std::collections::BTreeMap;
use std::env;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

/// The longest definition, in bytes.
const LONGEST: u64 = 1 << 20;
/// How many levels below a path of `ROS_PACKAGE_PATH` a package may be.
const DEEPEST: usize = 6;
/// The most directories that are searched for packages.
const MOST_DIRECTORIES: usize = 20_000;

/// Finds the files of packages.
#[derive(Debug, Clone, Default)]
pub(super) struct Packages {
    /// Where packages are, the first counts most.
    roots: Vec<PathBuf>,
    /// The directories of each package, once they were searched.
    found: Option<BTreeMap<String, Vec<PathBuf>>>,
}

/// The paths in an environment variable.
fn paths(variable: &str) -> Vec<PathBuf> {
    let value = env::var_os(variable).unwrap_or_default();
    env::split_paths(&value).collect()
}

/// A path of `ROS_PACKAGE_PATH` that is not used, because it is relative or not a directory.
pub(super) fn useless_path() -> Option<PathBuf> {
    let is_useful = |path: &PathBuf| path.is_absolute() && path.is_dir();
    let mut paths = paths("ROS_PACKAGE_PATH").into_iter();
    paths.find(|path| !path.as_os_str().is_empty() && !is_useful(path))
}

impl Packages {
    pub(super) const fn new(roots: Vec<PathBuf>) -> Self {
        Self { roots, found: None }
    }

    /// The places of this machine's ROS: those that its environment names, and those where it is usually installed.
    pub(super) fn of_this_machine() -> Self {
        let mut roots = paths("ROS_PACKAGE_PATH");
        // Definitions that were made from those of actions.
        let prefixes = paths("CMAKE_PREFIX_PATH").into_iter();
        roots.extend(prefixes.map(|prefix| prefix.join("share")));
        let mut installed: Vec<PathBuf> = directories(Path::new("/opt/ros"))
            .map(|distribution| distribution.join("share"))
            .collect();
        installed.sort();
        // The newest distribution of ROS 1 has the last name in the alphabet.
        roots.extend(installed.into_iter().rev());
        roots.push(PathBuf::from("/usr/share"));
        roots.retain(|root| root.is_absolute());
        Self::new(roots)
    }

    /// The first of these files, kind and name, in the first directory of the package that has one of them: its index, its
    /// path and its text. `None` if no directory has any.
    pub(super) fn read(
        &mut self,
        package: &str,
        files: &[(&str, &str)],
    ) -> Option<(usize, PathBuf, Result<String, String>)> {
        let directories = self.found().get(package)?.iter();
        let (which, path) = directories
            .flat_map(|directory| {
                let path = |(kind, name)| directory.join(kind).join(format!("{name}.{kind}"));
                files.iter().copied().map(path).enumerate()
            })
            .find(|(_, path)| path.is_file())?;
        let text = read(&path);
        Some((which, path, text))
    }

    /// The names of all files of this kind, as `package/Name`.
    pub(super) fn names(&mut self, kind: &str) -> Vec<String> {
        let mut names = Vec::new();
        for (package, directories) in self.found() {
            for directory in directories {
                for entry in fs::read_dir(directory.join(kind)).into_iter().flatten() {
                    let Ok(entry) = entry else { continue };
                    let file = entry.file_name();
                    let name = file.to_str().and_then(|file| file.strip_suffix(kind));
                    let name = name.and_then(|name| name.strip_suffix('.'));
                    names.extend(name.map(|name| format!("{package}/{name}")));
                }
            }
        }
        names
    }

    fn found(&mut self) -> &BTreeMap<String, Vec<PathBuf>> {
        let roots = &self.roots;
        self.found.get_or_insert_with(|| {
            let mut found = BTreeMap::new();
            let mut left = MOST_DIRECTORIES;
            for root in roots {
                search(root, DEEPEST, &mut left, &mut found);
            }
            found
        })
    }
}

/// Searches a directory for packages.
fn search(
    directory: &Path,
    levels: usize,
    left: &mut usize,
    found: &mut BTreeMap<String, Vec<PathBuf>>,
) {
    if *left == 0 {
        return;
    }
    *left -= 1;
    let has = |name: &str| directory.join(name).exists();
    if has("CATKIN_IGNORE") {
        return;
    }
    let marks = ["package.xml", "manifest.xml", "msg", "srv", "action"];
    let is_package = marks.into_iter().any(has);
    if is_package && let Some(name) = directory.file_name().and_then(|name| name.to_str()) {
        found
            .entry(name.to_owned())
            .or_default()
            .push(directory.to_owned());
        return;
    }
    // Below /usr/share there are thousands of directories without packages.
    let parent = directory.parent();
    if levels == 0 || parent.is_some_and(|parent| parent.starts_with("/usr/share")) {
        return;
    }
    let mut below: Vec<PathBuf> = directories(directory).collect();
    below.sort();
    for directory in below {
        search(&directory, levels - 1, left, found);
    }
}

/// The directories within one, without hidden ones.
fn directories(directory: &Path) -> impl Iterator<Item = PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    let shown = entries.filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."));
    shown.map(|entry| entry.path()).filter(|path| path.is_dir())
}

/// The text of a file with `\n` as its line break, as Python reads it.
fn read(path: &Path) -> Result<String, String> {
    let mut bytes = Vec::new();
    let file = fs::File::open(path).map_err(|error| error.to_string())?;
    let read = file.take(LONGEST + 1).read_to_end(&mut bytes);
    read.map_err(|error| error.to_string())?;
    if bytes.len() as u64 > LONGEST {
        return Err(format!("it is longer than {LONGEST} bytes"));
    }
    let text = String::from_utf8_lossy(&bytes);
    Ok(text.replace("\r\n", "\n").replace('\r', "\n"))
}
