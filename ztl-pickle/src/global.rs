//! The names that a pickle may use. Any other name is refused.

use crate::Error;

/// What a pickle may call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Global {
    Encode,
    Bytes,
    ByteArray,
    Set,
    FrozenSet,
    OrderedDict,
    Date,
    Time,
    DateTime,
    Delta,
    Zone,
    DType,
    NdArray,
    Reconstruct,
    Scalar,
    FromBuffer,
}

/// Each name. The first module is what we write: Python 2 and 3 and old and new numpy know it.
const NAMES: [(Global, &[&str], &str); 16] = [
    (Global::Encode, &["_codecs"], "encode"),
    (Global::Bytes, &BUILTINS, "bytes"),
    (Global::ByteArray, &BUILTINS, "bytearray"),
    (Global::Set, &BUILTINS, "set"),
    (Global::FrozenSet, &BUILTINS, "frozenset"),
    (Global::OrderedDict, &["collections"], "OrderedDict"),
    (Global::Date, &["datetime"], "date"),
    (Global::Time, &["datetime"], "time"),
    (Global::DateTime, &["datetime"], "datetime"),
    (Global::Delta, &["datetime"], "timedelta"),
    (Global::Zone, &["datetime"], "timezone"),
    (Global::DType, &["numpy"], "dtype"),
    (Global::NdArray, &["numpy"], "ndarray"),
    (
        Global::Reconstruct,
        &["numpy.core.multiarray", "numpy._core.multiarray"],
        "_reconstruct",
    ),
    (
        Global::Scalar,
        &["numpy.core.multiarray", "numpy._core.multiarray"],
        "scalar",
    ),
    (
        Global::FromBuffer,
        &["numpy.core.numeric", "numpy._core.numeric"],
        "_frombuffer",
    ),
];
const BUILTINS: [&str; 2] = ["__builtin__", "builtins"];

impl Global {
    pub(crate) fn find(module: &[u8], name: &[u8]) -> Result<Self, Error> {
        let known = NAMES.iter().find(|(_, modules, known)| {
            known.as_bytes() == name && modules.iter().any(|known| known.as_bytes() == module)
        });
        known.map_or_else(
            || Err(Error::refused(module, name)),
            |(global, ..)| Ok(*global),
        )
    }

    /// Its module and name.
    pub(crate) fn names(self) -> (&'static str, &'static str) {
        let known = NAMES.iter().find(|(global, ..)| *global == self);
        let (module, name) = known.map_or((None, ""), |(_, modules, name)| (modules.first(), name));
        (module.copied().unwrap_or_default(), name)
    }

    pub(crate) fn refused(self) -> Error {
        let (module, name) = self.names();
        Error::refused(module.as_bytes(), name.as_bytes())
    }
}
