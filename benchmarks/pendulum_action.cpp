// The pendulum's step and cost of pendulum.py as a crocoddyl action model, written by hand.
// `make peers` builds it into the environment of the peers, as the module pendulum_action.

#include <boost/python.hpp>
#include <cmath>
#include <crocoddyl/core/action-base.hpp>
#include <crocoddyl/core/states/euclidean.hpp>
#include <memory>

namespace bp = boost::python;
using crocoddyl::ActionDataAbstract;

class PendulumAction : public crocoddyl::ActionModelAbstract {
 public:
  typedef Eigen::Ref<const Eigen::VectorXd> Vector;

  PendulumAction(double angle_weight, double rate_weight, double control_weight, double goal,
                 double dt, double gravity)
      : crocoddyl::ActionModelAbstract(std::make_shared<crocoddyl::StateVector>(2), 1, 0),
        weight_(angle_weight, rate_weight),
        control_(control_weight),
        goal_(goal),
        dt_(dt),
        gravity_(gravity) {}

  void calc(const std::shared_ptr<ActionDataAbstract>& data, const Vector& x,
            const Vector& u) override {
    step(*data, x, u[0]);
  }

  void calc(const std::shared_ptr<ActionDataAbstract>& data, const Vector& x) override {
    step(*data, x, 0.0);
  }

  void calcDiff(const std::shared_ptr<ActionDataAbstract>& data, const Vector& x,
                const Vector& u) override {
    slopes(*data, x, u[0]);
  }

  void calcDiff(const std::shared_ptr<ActionDataAbstract>& data, const Vector& x) override {
    slopes(*data, x, 0.0);
  }

  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override {
    return std::make_shared<PendulumAction>(*this);
  }

  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override {
    throw std::runtime_error("double precision alone");
  }

 private:
  void step(ActionDataAbstract& data, const Vector& x, double torque) const {
    const double rate = x[1] + dt_ * (torque - gravity_ * std::sin(x[0]));
    data.xnext << x[0] + dt_ * rate, rate;
    const double off = x[0] - goal_;
    data.cost = weight_[0] * off * off + weight_[1] * x[1] * x[1] + control_ * torque * torque;
  }

  void slopes(ActionDataAbstract& data, const Vector& x, double torque) const {
    const double slope = -gravity_ * std::cos(x[0]);
    data.Fx << 1.0 + dt_ * dt_ * slope, dt_, dt_ * slope, 1.0;
    data.Fu << dt_ * dt_, dt_;
    data.Lx << 2.0 * weight_[0] * (x[0] - goal_), 2.0 * weight_[1] * x[1];
    data.Lxx.diagonal() = 2.0 * weight_;
    data.Lu << 2.0 * control_ * torque;
    data.Luu << 2.0 * control_;
  }

  Eigen::Vector2d weight_;
  double control_, goal_, dt_, gravity_;
};

BOOST_PYTHON_MODULE(pendulum_action) {
  bp::import("crocoddyl");
  bp::class_<PendulumAction, bp::bases<crocoddyl::ActionModelAbstract>,
             std::shared_ptr<PendulumAction>>(
      "PendulumAction", bp::init<double, double, double, double, double, double>());
}
