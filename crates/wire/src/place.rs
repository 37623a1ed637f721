//! Place descriptors.

use crate::field::{At, FieldError, Wire, limits};
use crate::v1;
use coma_place::{Descriptor, Space};

impl Wire for Descriptor {
    type Message = v1::Descriptor;

    fn to_wire(&self) -> v1::Descriptor {
        v1::Descriptor {
            space: self.space().as_str().to_owned(),
            scale: self.scale(),
            values: self.values().iter().map(|v| v.cast_unsigned()).collect(),
        }
    }

    fn from_wire(m: v1::Descriptor, at: &At<'_>) -> Result<Self, FieldError> {
        let space = Space::new(&m.space).map_err(|e| at.field("space").refuse(e.to_string()))?;
        if !(m.scale > 0.0 && m.scale <= 1.0) {
            return Err(at.field("scale").refuse(format!("{} is not within 0 (excluded) and 1", m.scale)));
        }
        let values = at.field("values");
        if m.values.is_empty() {
            return Err(values.refuse("is empty"));
        }
        values.at_most(m.values.len(), limits::DESCRIPTOR_VALUES, "values")?;
        let signed = m.values.iter().map(|v| v.cast_signed()).collect();
        Descriptor::new(space, m.scale, signed).map_err(|e| values.refuse(e.to_string()))
    }
}
