// Bullet's contacts of convex parts and spheres by plain functions, in double precision. Build: see docs/rivals.md.
#define BT_USE_DOUBLE_PRECISION 1
#include <btBulletCollisionCommon.h>

#include <vector>

static btCollisionDispatcher* dispatcher;
static btCollisionWorld* world;
static std::vector<btCollisionObject*> objects;

static int add(btCollisionShape* shape, bool fixed) {
  auto* object = new btCollisionObject();
  object->setCollisionShape(shape);
  object->setCollisionFlags(fixed ? btCollisionObject::CF_STATIC_OBJECT : 0);
  object->setUserIndex(static_cast<int>(objects.size()));
  objects.push_back(object);
  const int every = btBroadphaseProxy::AllFilter, still = btBroadphaseProxy::StaticFilter;
  world->addCollisionObject(object, fixed ? still : btBroadphaseProxy::DefaultFilter, fixed ? every ^ still : every);
  return static_cast<int>(objects.size()) - 1;
}

extern "C" {

void bullet_open() {
  dispatcher = new btCollisionDispatcher(new btDefaultCollisionConfiguration());
  world = new btCollisionWorld(dispatcher, new btDbvtBroadphase(), nullptr);
  objects.clear();
}

// corners: of all parts, one after the other; counts: how many each part has.
int bullet_parts(const double* corners, const int* counts, int parts, double margin, int fixed) {
  auto* all = new btCompoundShape();
  for (int part = 0; part < parts; part++) {
    auto* hull = new btConvexHullShape();
    for (int k = 0; k < counts[part]; k++, corners += 3) hull->addPoint({corners[0], corners[1], corners[2]}, false);
    hull->recalcLocalAabb();
    hull->setMargin(margin);
    if (parts == 1) return add(hull, fixed);
    all->addChildShape(btTransform::getIdentity(), hull);
  }
  return add(all, fixed);
}

int bullet_sphere(double radius) { return add(new btSphereShape(radius), false); }

void bullet_place(int number, const double* p, const double* xyzw) {
  btTransform pose;
  pose.setOrigin({p[0], p[1], p[2]});
  pose.setRotation({xyzw[0], xyzw[1], xyzw[2], xyzw[3]});
  objects[number]->setWorldTransform(pose);
  objects[number]->setInterpolationWorldTransform(pose);
  objects[number]->activate(true);
  world->updateSingleAabb(objects[number]);
}

// out: rows of 12: the two bodies, points on both, the normal on the second, the distance. Returns how many.
int bullet_contacts(double* out, int most) {
  world->performDiscreteCollisionDetection();
  int count = 0;
  for (int m = 0; m < dispatcher->getNumManifolds(); m++) {
    const btPersistentManifold* pair = dispatcher->getManifoldByIndexInternal(m);
    for (int k = 0; k < pair->getNumContacts() && count < most; k++, count++) {
      const btManifoldPoint& point = pair->getContactPoint(k);
      double* row = out + 12 * count;
      row[0] = pair->getBody0()->getUserIndex();
      row[1] = pair->getBody1()->getUserIndex();
      for (int i = 0; i < 3; i++) {
        row[2 + i] = point.getPositionWorldOnA()[i];
        row[5 + i] = point.getPositionWorldOnB()[i];
        row[8 + i] = point.m_normalWorldOnB[i];
      }
      row[11] = point.getDistance();
    }
  }
  return count;
}
}
