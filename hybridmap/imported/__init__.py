"""Maps of other mappers, made sessions: experience maps of OpenRatSLAM, from bags and tables."""
