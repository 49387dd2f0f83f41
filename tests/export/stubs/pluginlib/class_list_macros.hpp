// A stand-in for pluginlib: the class that is exported is the one that the stand-in's main makes.
#pragma once

#define PLUGINLIB_EXPORT_CLASS(Class, Base)  \
  Base * stub_make();                        \
  Base * stub_make() { return new Class; }
