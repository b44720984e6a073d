//! Parameters: typed values such as calibrations, limits and names, which people read and set with `ztl param` while the
//! device works, and save so that they survive a restart (`docs/link.md`, section 13). Firmware without [`Tuned`] has no
//! code for them.
//!
//! [`parameters!`](crate::parameters!) declares a struct whose fields are parameters. A component owns one and reads its fields, which costs
//! nothing more than any other field. Values change only between two calls of the node, and only while the component has no
//! task.
//!
//! ```
//! use ztl_mcu::{Component, Components, parameters};
//! use ztl_mcu::parameters::{Declaration, Text, Tunable, Tuned, Value};
//!
//! parameters! {
//!     /// What differs from one finger to the next.
//!     #[derive(Debug, Clone, PartialEq)]
//!     pub struct Calibration {
//!         pub speed: f32 = Parameter::<f32>::new(50.0).range(1.0, 100.0)
//!             .unit("percent/s").about("how fast it opens");
//!         pub offset: i32 = Parameter::<i32>::new(0).range(-2048, 2047).unit("steps");
//!         pub reversed: bool = Parameter::<bool>::new(false).about("opens the other way");
//!         pub label: Text<16> = Parameter::<Text<16>>::new("");
//!     }
//! }
//!
//! /// Implements [`Component`](crate::Component) and reads `self.calibration.speed`.
//! struct Finger { calibration: Calibration }
//!
//! impl Tunable for Finger {
//!     const PARAMETERS: &'static [Declaration] = Calibration::PARAMETERS;
//!     fn value(&self, index: usize) -> Option<Value<'_>> {
//!         self.calibration.value(index)
//!     }
//!     fn set(&mut self, index: usize, value: Value<'_>) {
//!         self.calibration.set(index, value);
//!         // Here a driver would pass the value on to its hardware.
//!     }
//! }
//!
//! let finger = Finger { calibration: Calibration::default() };
//! assert_eq!(finger.calibration.speed, 50.0);
//!
//! fn components(finger: impl Component + Tunable) -> impl Components {
//!     // Instead of `(finger,)`, for `Node::new`.
//!     Tuned::new((finger,))
//! }
//! ```
//!
//! [`Tuned::load`] saves values in a [`Storage`]: with the feature `flash` in any NOR flash that implements
//! `embedded-storage` (`Flash`), or in an EEPROM or a file of the firmware's own.

mod declare;
#[cfg(feature = "flash")]
mod flash;
mod tuned;

pub use declare::{Declaration, Parameter, ParameterType, Text};
#[cfg(feature = "flash")]
pub use flash::Flash;
pub use tuned::{SaveError, Storage, Tuned, Tuning};
pub use ztl_core::link::parameter::{Domain, Kept, Unfit, Value};

/// A part with parameters: a struct of [`parameters!`](crate::parameters!), or a component that has one.
pub trait Tunable {
    /// Its parameters. Must not change from one version of the firmware to the next except by intention: saved values
    /// are found by the names of component and parameter.
    const PARAMETERS: &'static [Declaration] = &[];

    /// The value of the parameter with this index.
    fn value(&self, index: usize) -> Option<Value<'_>> {
        let _ = index;
        None
    }

    /// Sets the parameter with this index to a value that fits its declaration. Called between two tasks, and at the
    /// start of the firmware.
    fn set(&mut self, index: usize, value: Value<'_>) {
        let _ = (index, value);
    }
}

impl Tunable for () {}

impl<T: Tunable + ?Sized> Tunable for &mut T {
    const PARAMETERS: &'static [Declaration] = T::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        T::value(self, index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        T::set(self, index, value);
    }
}

/// Components with parameters: an array of one type, or a tuple of up to twelve. A type without parameters implements
/// [`Tunable`] with an empty body.
pub trait TuneAll {
    /// In the order of the components.
    const PARAMETERS: &'static [&'static [Declaration]];

    /// The value of a component's parameter.
    fn value(&self, component: usize, index: usize) -> Option<Value<'_>>;

    /// Sets a component's parameter.
    fn set(&mut self, component: usize, index: usize, value: Value<'_>);
}

impl<T: Tunable, const N: usize> TuneAll for [T; N] {
    const PARAMETERS: &'static [&'static [Declaration]] = &[T::PARAMETERS; N];

    fn value(&self, component: usize, index: usize) -> Option<Value<'_>> {
        self.get(component)?.value(index)
    }

    fn set(&mut self, component: usize, index: usize, value: Value<'_>) {
        if let Some(component) = self.get_mut(component) {
            component.set(index, value);
        }
    }
}

impl<C: TuneAll + ?Sized> TuneAll for &mut C {
    const PARAMETERS: &'static [&'static [Declaration]] = C::PARAMETERS;

    fn value(&self, component: usize, index: usize) -> Option<Value<'_>> {
        C::value(self, component, index)
    }

    fn set(&mut self, component: usize, index: usize, value: Value<'_>) {
        C::set(self, component, index, value);
    }
}

macro_rules! tuples {
    ($($($name:ident $place:tt),+;)+) => {
        $(impl<$($name: Tunable),+> TuneAll for ($($name,)+) {
            const PARAMETERS: &'static [&'static [Declaration]] = &[$($name::PARAMETERS),+];

            fn value(&self, component: usize, index: usize) -> Option<Value<'_>> {
                match component {
                    $($place => self.$place.value(index),)+
                    _ => None,
                }
            }

            fn set(&mut self, component: usize, index: usize, value: Value<'_>) {
                match component {
                    $($place => self.$place.set(index, value),)+
                    _ => {}
                }
            }
        })+
    };
}

tuples! {
    A 0;
    A 0, B 1;
    A 0, B 1, C 2;
    A 0, B 1, C 2, D 3;
    A 0, B 1, C 2, D 3, E 4;
    A 0, B 1, C 2, D 3, E 4, F 5;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10;
    A 0, B 1, C 2, D 3, E 4, F 5, G 6, H 7, I 8, J 9, K 10, L 11;
}
