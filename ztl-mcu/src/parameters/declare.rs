//! Declares parameters.

use core::marker::PhantomData;

use ztl_core::link::parameter::{Domain, LONGEST_PARAMETER, Value};

/// A text of at most `N` bytes.
pub type Text<const N: usize> = heapless::String<N>;

/// A type of parameters: `bool`, `u32`, `i32`, `f32` or [`Text`].
pub trait ParameterType {
    /// The value of a parameter of this type, or an empty one for a value of another kind.
    fn of(value: Value<'_>) -> Self;

    /// As a value.
    fn value(&self) -> Value<'_>;
}

/// The declaration of a parameter; made by [`Parameter::declare`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Declaration {
    /// Its name, which differs from those of the other parameters of its component.
    pub name: &'static str,
    /// Unit of the numbers; may be empty.
    pub unit: &'static str,
    /// What it means, for people; may be empty.
    pub about: &'static str,
    /// The values that it takes.
    pub domain: Domain,
    /// Its value until it is set.
    pub default: Value<'static>,
}

impl Declaration {
    /// Bytes of its longest message.
    const fn longest(&self) -> usize {
        // Each value is written twice: the default and the current one.
        let (domain, value) = match self.domain {
            Domain::Bool => (1, 2),
            Domain::U32 { .. } | Domain::I32 { .. } => (11, 6),
            Domain::F32 { .. } => (9, 5),
            Domain::Text { longest } => (2, 2 + longest as usize),
        };
        7 + self.name.len() + self.unit.len() + self.about.len() + domain + 2 * value
    }

    const fn default_fits(&self) -> bool {
        match (self.domain, self.default) {
            (Domain::U32 { least, most }, Value::U32(number)) => least <= number && number <= most,
            (Domain::I32 { least, most }, Value::I32(number)) => least <= number && number <= most,
            (Domain::F32 { least, most }, Value::F32(number)) => least <= number && number <= most,
            (Domain::Text { longest }, Value::Text(text)) => text.len() <= longest as usize,
            _ => true,
        }
    }
}

/// A parameter of type `T` to be declared: its default, and what [`range`](Parameter::<f32>::range), [`unit`](Self::unit)
/// and [`about`](Self::about) add.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter<T>(Declaration, PhantomData<fn() -> T>);

impl<T> Parameter<T> {
    const fn of(default: Value<'static>, domain: Domain) -> Self {
        let declaration = Declaration {
            name: "",
            unit: "",
            about: "",
            domain,
            default,
        };
        Self(declaration, PhantomData)
    }

    const fn within(mut self, domain: Domain) -> Self {
        self.0.domain = domain;
        self
    }

    /// The unit of its numbers.
    #[must_use]
    pub const fn unit(mut self, unit: &'static str) -> Self {
        self.0.unit = unit;
        self
    }

    /// What it means, for people.
    #[must_use]
    pub const fn about(mut self, about: &'static str) -> Self {
        self.0.about = about;
        self
    }

    /// Declares it under a name; [`parameters!`](crate::parameters!) calls this.
    ///
    /// # Panics
    /// In a constant, which the compiler reports: the default is out of the range, or the message of the parameter takes
    /// more than 120 bytes, so that its texts must be shorter.
    #[must_use]
    pub const fn declare(mut self, name: &'static str) -> Declaration {
        self.0.name = name;
        assert!(
            self.0.default_fits(),
            "the default of a parameter is out of its range"
        );
        assert!(
            self.0.longest() <= LONGEST_PARAMETER,
            "the name, unit and meaning of a parameter are too long: its message takes more than 120 bytes"
        );
        self.0
    }
}

impl ParameterType for bool {
    fn of(value: Value<'_>) -> Self {
        matches!(value, Value::Bool(true))
    }

    fn value(&self) -> Value<'_> {
        Value::Bool(*self)
    }
}

impl Parameter<bool> {
    /// A switch with this default.
    #[must_use]
    pub const fn new(default: bool) -> Self {
        Self::of(Value::Bool(default), Domain::Bool)
    }
}

macro_rules! numbers {
    ($($type:ident $kind:ident: $what:literal;)+) => {
        $(impl ParameterType for $type {
            fn of(value: Value<'_>) -> Self {
                match value {
                    Value::$kind(number) => number,
                    _ => <$type>::default(),
                }
            }

            fn value(&self) -> Value<'_> {
                Value::$kind(*self)
            }
        }

        impl Parameter<$type> {
            #[doc = $what]
            #[must_use]
            pub const fn new(default: $type) -> Self {
                let (least, most) = ($type::MIN, $type::MAX);
                Self::of(Value::$kind(default), Domain::$kind { least, most })
            }

            /// Takes only numbers from `least` to `most`.
            #[must_use]
            pub const fn range(self, least: $type, most: $type) -> Self {
                self.within(Domain::$kind { least, most })
            }
        })+
    };
}

numbers! {
    u32 U32: "A number without sign, with this default.";
    i32 I32: "A whole number with this default.";
    f32 F32: "A number with this default.";
}

impl<const N: usize> ParameterType for Text<N> {
    fn of(value: Value<'_>) -> Self {
        let mut own = Self::new();
        if let Value::Text(text) = value {
            // It fits: the declaration's length is `N`.
            let _ = own.push_str(text);
        }
        own
    }

    fn value(&self) -> Value<'_> {
        Value::Text(self)
    }
}

impl<const N: usize> Parameter<Text<N>> {
    /// A text with this default.
    #[must_use]
    pub const fn new(default: &'static str) -> Self {
        const { assert!(N <= 48, "a text parameter has at most 48 bytes") };
        let longest = N as u8;
        Self::of(Value::Text(default), Domain::Text { longest })
    }
}

/// Declares a struct whose fields are parameters, with their defaults as its `Default`, and implements
/// [`Tunable`](crate::parameters::Tunable) for it. See [`parameters`](mod@crate::parameters).
#[macro_export]
macro_rules! parameters {
    (
        $(#[$meta:meta])*
        $vis:vis struct $name:ident {
            $($(#[$field_meta:meta])* $field_vis:vis $field:ident: $type:ty = $declared:expr;)+
        }
    ) => {
        $(#[$meta])*
        $vis struct $name {
            $($(#[$field_meta])* $field_vis $field: $type,)+
        }

        const _: () = {
            use $crate::parameters::{Declaration, Parameter, ParameterType, Tunable, Value};

            impl Default for $name {
                fn default() -> Self {
                    Self {
                        $($field: {
                            const DECLARED: Parameter<$type> = $declared;
                            const NAMED: Declaration = DECLARED.declare(stringify!($field));
                            ParameterType::of(NAMED.default)
                        },)+
                    }
                }
            }

            impl Tunable for $name {
                const PARAMETERS: &'static [Declaration] = &[$({
                    const DECLARED: Parameter<$type> = $declared;
                    DECLARED.declare(stringify!($field))
                },)+];

                fn value(&self, index: usize) -> Option<Value<'_>> {
                    let mut left = index;
                    $(
                        if left == 0 {
                            return Some(ParameterType::value(&self.$field));
                        }
                        left -= 1;
                    )+
                    let _ = left;
                    None
                }

                fn set(&mut self, index: usize, value: Value<'_>) {
                    let mut left = index;
                    $(
                        if left == 0 {
                            self.$field = ParameterType::of(value);
                            return;
                        }
                        left -= 1;
                    )+
                    let _ = left;
                }
            }
        };
    };
}
