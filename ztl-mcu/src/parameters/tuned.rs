//! The components of a node together with their parameters, and where values are saved.

use ztl_core::link::parameter::{Kept, NO_COMPONENT, Parameter, Unfit, Value};
use ztl_core::sink::SliceSink;

use super::{Declaration, Tunable, TuneAll};
use crate::component::{Components, forward};
use crate::describe::DescribeAll;

/// Longest saved value: kind, length, and a text of 48 bytes.
pub(super) const LONGEST_VALUE: usize = 50;

/// Where values are saved. `()` saves nothing.
pub trait Storage {
    /// Reads what was last written under a key into `buffer`; returns its length, or `None` if nothing was.
    ///
    /// # Errors
    /// [`SaveError::Failed`] if it cannot be read.
    fn read(&mut self, key: u64, buffer: &mut [u8]) -> Result<Option<usize>, SaveError>;

    /// Writes bytes under a key. After a power cut at any moment, [`read`](Self::read) returns these bytes or those before.
    ///
    /// # Errors
    /// [`SaveError::Failed`] if they cannot be written.
    fn write(&mut self, key: u64, bytes: &[u8]) -> Result<(), SaveError>;
}

impl Storage for () {
    fn read(&mut self, _: u64, _: &mut [u8]) -> Result<Option<usize>, SaveError> {
        Ok(None)
    }

    fn write(&mut self, _: u64, _: &[u8]) -> Result<(), SaveError> {
        Err(SaveError::NoStorage)
    }
}

/// Why values were not saved.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub enum SaveError {
    /// The firmware has no storage.
    NoStorage,
    /// The storage is full or broken. Some values may be saved.
    Failed,
}

/// The parameters of a node, by their numbers on the link: those of the components in their order, then the firmware's own.
pub trait Tuning {
    /// The parameter with this number.
    fn parameter(&self, index: u8) -> Option<Parameter<'_>>;

    /// Sets the parameter with this number; an unknown number changes nothing.
    ///
    /// # Errors
    /// [`Unfit`]; the value is unchanged.
    fn set(&mut self, index: u8, value: Value<'_>) -> Result<(), Unfit>;

    /// Saves the values that differ from the saved ones. Takes as long as the storage does.
    ///
    /// # Errors
    /// [`SaveError`].
    fn save(&mut self) -> Result<(), SaveError>;
}

/// Components whose parameters clients may read and set, the firmware's own parameters `P`, and the storage `S` for at most
/// `N` values.
///
/// The firmware may change values itself at any time. [`save`](Tuning::save) writes them like any others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Tuned<C, P = (), S = (), const N: usize = 0> {
    /// The components.
    pub components: C,
    /// The firmware's own parameters.
    pub firmware: P,
    storage: S,
    /// A digest of each value that a restart would give; [`UNFIT`] if the saved value does not fit.
    saved: [u32; N],
}

/// No digest of a value.
const UNFIT: u32 = 0;

impl<C: Components + TuneAll> Tuned<C> {
    /// The components with their parameters; without [`load`](Self::load), a restart sets the defaults.
    pub const fn new(components: C) -> Self {
        Self {
            components,
            firmware: (),
            storage: (),
            saved: [],
        }
    }

    /// Adds parameters that belong to no component. They can be set only while no task runs.
    pub fn with_firmware<P: Tunable>(self, firmware: P) -> Tuned<C, P> {
        Tuned {
            components: self.components,
            firmware,
            storage: (),
            saved: [],
        }
    }
}

impl<C: Components + TuneAll, P: Tunable> Tuned<C, P> {
    /// Sets all parameters to their saved values. A parameter keeps its value if none was saved, or if the saved one cannot be
    /// read or does not fit the declaration any more; in the latter two cases it is [`Kept::Replaced`]. `N` is the number of parameters, or more.
    pub fn load<S: Storage, const N: usize>(self, storage: S) -> Tuned<C, P, S, N> {
        const {
            assert!(
                count::<C, P>() <= N,
                "there are more parameters than values that can be saved: raise N"
            );
        }
        let mut tuned = Tuned {
            components: self.components,
            firmware: self.firmware,
            storage,
            saved: [UNFIT; N],
        };
        for index in 0..count::<C, P>() as u8 {
            let mut buffer = [0; LONGEST_VALUE];
            let found = tuned.storage.read(tuned.key(index), &mut buffer);
            let fits = match found {
                Ok(None) => true,
                Ok(Some(len)) => {
                    let value = Value::parse(buffer.get(..len).unwrap_or_default());
                    value.is_ok_and(|value| tuned.set(index, value).is_ok())
                }
                Err(_) => false,
            };
            if fits {
                tuned.note_saved(index);
            }
        }
        tuned
    }
}

/// Number of parameters.
const fn count<C: TuneAll, P: Tunable>() -> usize {
    let (mut rest, mut count) = (C::PARAMETERS, P::PARAMETERS.len());
    while let [first, behind @ ..] = rest {
        count += first.len();
        rest = behind;
    }
    count
}

/// FNV-1a, from the digest of what came before.
fn digest(before: u64, bytes: &[u8]) -> u64 {
    bytes.iter().fold(before, |digest, byte| {
        (digest ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

/// The digest of nothing.
const NOTHING: u64 = 0xcbf2_9ce4_8422_2325;

/// Encodes a value, and returns its digest too.
fn encoded<'b>(value: &Value<'_>, buffer: &'b mut [u8; LONGEST_VALUE]) -> (&'b [u8], u32) {
    let mut sink = SliceSink::new(buffer);
    value.put(&mut sink);
    let bytes = sink.finish().unwrap_or_default();
    // Never `UNFIT`.
    (bytes, digest(NOTHING, bytes) as u32 | 1)
}

impl<C: Components + TuneAll, P: Tunable, S: Storage, const N: usize> Tuned<C, P, S, N> {
    /// The component of a parameter, or [`NO_COMPONENT`], its index there, and its declaration.
    fn find(index: u8) -> Option<(u8, usize, &'static Declaration)> {
        let mut left = usize::from(index);
        for (component, its) in C::PARAMETERS.iter().enumerate() {
            if let Some(declaration) = its.get(left) {
                return Some((component as u8, left, declaration));
            }
            left -= its.len();
        }
        Some((NO_COMPONENT, left, P::PARAMETERS.get(left)?))
    }

    fn value(&self, component: u8, index: usize) -> Option<Value<'_>> {
        match component {
            NO_COMPONENT => self.firmware.value(index),
            component => self.components.value(usize::from(component), index),
        }
    }

    /// The key of a parameter's saved value: a digest of the names of its component and of itself, so that later
    /// firmware finds it, even if it adds or removes other parameters.
    fn key(&self, index: u8) -> u64 {
        let Some((component, _, declaration)) = Self::find(index) else {
            return NOTHING;
        };
        let component = self.components.component(usize::from(component));
        let name = component.map_or("", |component| component.offer().name);
        let prefix = digest(digest(NOTHING, name.as_bytes()), b".");
        digest(prefix, declaration.name.as_bytes())
    }

    /// Remembers that a restart gives the current value.
    fn note_saved(&mut self, index: u8) {
        let digest = self.digest_of(index);
        if let Some(saved) = self.saved.get_mut(usize::from(index)) {
            *saved = digest;
        }
    }

    fn digest_of(&self, index: u8) -> u32 {
        let found = Self::find(index);
        let value = found.and_then(|(component, own, _)| self.value(component, own));
        value.map_or(UNFIT, |value| encoded(&value, &mut [0; LONGEST_VALUE]).1)
    }
}

impl<C: Components + TuneAll, P: Tunable, S: Storage, const N: usize> Tuning for Tuned<C, P, S, N> {
    fn parameter(&self, index: u8) -> Option<Parameter<'_>> {
        let (component, own, declaration) = Self::find(index)?;
        let value = self.value(component, own)?;
        let kept = match self.saved.get(usize::from(index)) {
            None => Kept::Never,
            Some(&saved) if saved == self.digest_of(index) => Kept::Saved,
            Some(&UNFIT) if value == declaration.default => Kept::Replaced,
            Some(_) => Kept::Changed,
        };
        Some(Parameter {
            index,
            component,
            name: declaration.name,
            unit: declaration.unit,
            about: declaration.about,
            kept,
            domain: declaration.domain,
            default: declaration.default,
            value,
        })
    }

    fn set(&mut self, index: u8, value: Value<'_>) -> Result<(), Unfit> {
        let Some((component, own, declaration)) = Self::find(index) else {
            return Ok(());
        };
        declaration.domain.check(&value)?;
        match component {
            NO_COMPONENT => self.firmware.set(own, value),
            component => self.components.set(usize::from(component), own, value),
        }
        Ok(())
    }

    fn save(&mut self) -> Result<(), SaveError> {
        if N == 0 {
            return Err(SaveError::NoStorage);
        }
        // The second time for a storage that had to forget all values when one was written.
        for index in (0..count::<C, P>() as u8).chain(0..count::<C, P>() as u8) {
            let Some((component, own, declaration)) = Self::find(index) else {
                continue;
            };
            let Some(value) = self.value(component, own) else {
                continue;
            };
            // A default that was never saved follows the firmware.
            let is_default = value == declaration.default;
            let mut buffer = [0; LONGEST_VALUE];
            let bytes = encoded(&value, &mut buffer).0;
            let key = self.key(index);
            let mut before = [0; LONGEST_VALUE];
            let is_saved = match self.storage.read(key, &mut before) {
                Ok(Some(len)) => before.get(..len) == Some(bytes),
                Ok(None) => is_default,
                Err(_) => false,
            };
            if !is_saved {
                self.storage.write(key, bytes)?;
            }
            self.note_saved(index);
        }
        Ok(())
    }
}

impl<C: Components + TuneAll, P: Tunable, S: Storage, const N: usize> Components
    for Tuned<C, P, S, N>
{
    const PARAMETER_COUNT: u8 = {
        assert!(count::<C, P>() <= 255, "a node has at most 255 parameters");
        count::<C, P>() as u8
    };

    forward!(components: parts descriptions bus own_work updates);

    fn tuning(&self) -> Option<&dyn Tuning> {
        Some(self)
    }

    fn tuning_mut(&mut self) -> Option<&mut dyn Tuning> {
        Some(self)
    }
}

impl<C: DescribeAll, P, S, const N: usize> DescribeAll for Tuned<C, P, S, N> {
    const DESCRIPTIONS: &'static [&'static str] = C::DESCRIPTIONS;
}
