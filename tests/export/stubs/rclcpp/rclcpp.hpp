// A stand-in for rclcpp and rclcpp_lifecycle: what an exported controller uses of them.
#pragma once

#include <cstdio>
#include <map>
#include <string>
#include <vector>

#define RCLCPP_ERROR(logger, ...) ((void)(logger), std::fprintf(stderr, __VA_ARGS__))

namespace rclcpp
{
class Time {};
class Duration
{
public:
  explicit Duration(double seconds) : seconds_(seconds) {}
  double seconds() const { return seconds_; }

private:
  double seconds_;
};
class Logger {};

class Parameter
{
public:
  Parameter() = default;
  explicit Parameter(const std::vector<std::string> & v) : array_(v) {}
  explicit Parameter(const std::string & v) : text_(v) {}
  explicit Parameter(bool v) : flag_(v) {}
  std::vector<std::string> as_string_array() const { return array_; }
  std::string as_string() const { return text_; }
  bool as_bool() const { return flag_; }

private:
  std::vector<std::string> array_;
  std::string text_;
  bool flag_ = false;
};
}  // namespace rclcpp

namespace rclcpp_lifecycle
{
class State {};

class LifecycleNode
{
public:
  void declare(const std::string & name, const rclcpp::Parameter & value) { values_[name] = value; }
  rclcpp::Parameter get_parameter(const std::string & name) const { return values_.at(name); }
  rclcpp::Logger get_logger() const { return {}; }

private:
  std::map<std::string, rclcpp::Parameter> values_;
};
}  // namespace rclcpp_lifecycle
